"""A multiresolution hash grid and its network in plain torch (Mueller et al. 2022, "Instant neural graphics primitives"). N points, L levels."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from efficientnerf.backends.transfer import constant
from efficientnerf.fields.gradient_buffer import GradientBuffer

PRIME_Y, PRIME_Z = 2654435761, 805459861  # section 3


class HashLevels(NamedTuple):
    """Levels of a hash grid, and the places of their entries in the table."""

    sides: np.ndarray  # (L,) int64 resolution
    dense: np.ndarray  # (L,) bool: whether a level is dense, not hashed
    starts: np.ndarray  # (L,) int64 first entry
    mask: np.uint32  # entries of a hashed level, less one: all bits set


def encode(points: Tensor, table: Tensor, levels: HashLevels) -> Tensor:
    """Features (N, F L) at points (N, 3) in [0, 1]^3 from a table (entries, F); differentiable in both."""
    columns = []
    corner = torch.stack(torch.meshgrid(*[torch.arange(2, device=points.device)] * 3, indexing="ij"), dim=-1).reshape(8, 3)
    for side, dense, start in zip(levels.sides.tolist(), levels.dense.tolist(), levels.starts.tolist(), strict=True):
        x = points * (side - 1)
        low = x.detach().long().clamp(0, side - 2)
        fraction = x - low
        at = low[:, None] + corner  # (N, 8, 3)
        weight = torch.where(corner.bool(), fraction[:, None], 1 - fraction[:, None]).prod(dim=-1)
        if dense:
            entry = (at[..., 0] * side + at[..., 1]) * side + at[..., 2]
        else:
            wrap = 2**32
            entry = (at[..., 0] ^ (at[..., 1] * PRIME_Y % wrap) ^ (at[..., 2] * PRIME_Z % wrap)) & int(levels.mask)
        columns.append((weight[..., None] * table[start + entry]).sum(dim=1))
    return torch.cat(columns, dim=-1)


def relu_network(features: Tensor, weights: Sequence[Tensor], offset: float, precision: torch.dtype) -> Tensor:
    """(N, O) of features (N, I) through weights (O, I) each, a ReLU between them, in `precision`; `offset` is added to the first output."""
    x = features.to(precision)
    for weight in weights[:-1]:
        x = torch.relu(x @ weight.to(precision).t())
    raw = (x @ weights[-1].to(precision).t()).to(features.dtype)
    return raw + constant(offset * np.eye(1, raw.shape[1])[0], raw)


def hash_network(
    points: Tensor, table: Tensor, levels: HashLevels, weights: Sequence[Tensor], offset: float, precision: torch.dtype, gradient: GradientBuffer | None = None
) -> Tensor:
    """`relu_network` of `encode`.

    gradient  where numba's kernel adds the table's gradient; unused here
    """
    return relu_network(encode(points, table, levels), weights, offset, precision)
