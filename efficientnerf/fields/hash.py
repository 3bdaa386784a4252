"""A multiresolution hash grid (Mueller et al. 2022, "Instant neural graphics primitives") with spherical-harmonics output.

L levels of lattices between `coarsest` and `finest` points a side, two features a lattice point, in tables of 2^log2_table entries (a level that
fits is stored whole, one that does not is hashed); then a small ReLU network. The outputs do not see the direction, so the field bakes.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from efficientnerf.backends.dispatch import on_device
from efficientnerf.backends.numba.hash_grid import PRIME_Y, PRIME_Z
from efficientnerf.backends.torch.linear_chain import precision_of
from efficientnerf.fields.bakeable import BakeableField
from efficientnerf.fields.gradient_buffer import GradientBuffer
from efficientnerf.rendering.harmonics import harmonics_count

FEATURES = 2


class HashField(BakeableField):
    """hidden x layers ReLU network over 2L features; see `efficientnerf.fields`."""

    activation = "exp"

    def __init__(
        self, *, levels: int, log2_table: int, coarsest: int, finest: int, hidden: int, layers: int, degree: int,
        initial_density: float, generator: torch.Generator, precision: str = "float32",
    ) -> None:  # fmt: skip
        super().__init__()
        self.degree = degree
        growth = math.exp((math.log(finest) - math.log(coarsest)) / max(levels - 1, 1))
        sides = [round(coarsest * growth**level) for level in range(levels)]
        size = 2**log2_table
        dense = [side**3 <= size for side in sides]
        counts = [side**3 if flat else size for side, flat in zip(sides, dense, strict=True)]
        self.sides = np.array(sides, np.int64)
        self.dense = np.array(dense)
        self.starts = np.array([0, *np.cumsum(counts)[:-1]], np.int64)
        self.mask = np.uint32(size - 1)
        self.table = nn.Parameter((torch.rand(sum(counts), FEATURES, generator=generator) * 2 - 1) * 1e-4)
        self.table_gradient = GradientBuffer()
        widths = [levels * FEATURES, *[hidden] * layers, 1 + 3 * harmonics_count(degree)]
        self.weights = nn.ParameterList()
        for inputs, outputs in itertools.pairwise(widths):
            bound = math.sqrt(6 / inputs)  # He initialisation for ReLU
            self.weights.append(nn.Parameter((torch.rand(outputs, inputs, generator=generator) * 2 - 1) * bound))
        # The last layer starts small: grey colours, a density so thin that every ray sees through.
        self.weights[-1].data.mul_(0.1)
        self.log_initial_density = math.log(initial_density)
        self.precision = precision

    @property
    def gradient_buffers(self) -> dict[str, GradientBuffer]:
        return {"table": self.table_gradient}

    def forward(self, points: Tensor) -> Tensor:
        return self._network(points, self.weights[-1])

    def density(self, points: Tensor) -> Tensor:
        return self._network(points, self.weights[-1][:1])[:, 0]

    def _network(self, points: Tensor, last: Tensor) -> Tensor:
        weights = [*list(self.weights)[:-1], last]
        if _by_kernel(points, self):
            precision = precision_of(self.precision, "cpu") if torch.is_grad_enabled() else torch.float32
            return _Network.apply(points, self.table, self, precision, *weights)
        precision = precision_of(self.precision, points.device.type) if on_device(points, self.table) and torch.is_grad_enabled() else points.dtype
        x = encode(points, self).to(precision)
        for weight in weights[:-1]:
            x = torch.relu(x @ weight.to(precision).t())
        raw = (x @ last.to(precision).t()).to(points.dtype)
        offset = torch.zeros(raw.shape[1], dtype=raw.dtype, device=raw.device)
        offset[0] = self.log_initial_density
        return raw + offset


def _by_kernel(points: Tensor, field: HashField) -> bool:
    return points.device.type == "cpu" and points.dtype == torch.float32 and field.table.dtype == torch.float32


def encode(points: Tensor, field: HashField) -> Tensor:
    """Features (N, 2L) at points (N, 3) in grid coordinates; differentiable in the table."""
    if _by_kernel(points, field):
        return _Encode.apply(points, field.table, field)
    if on_device(points, field.table):
        from efficientnerf.backends.triton import hash_grid as cuda

        return cuda.encode(points, field.table, field.sides, field.dense, field.starts, int(field.mask))
    return encode_reference(points, field.table, field.sides, field.dense, field.starts, int(field.mask))


def _encoded(points: Tensor, table: Tensor, field: HashField) -> tuple[Tensor, Tensor]:
    """Points (3, N) and features (2L, N): the order that the kernels want."""
    from efficientnerf.backends.numba import hash_grid

    turned, out = torch.empty(3, len(points)), torch.empty(FEATURES * len(field.sides), len(points))
    hash_grid.transpose_points(points.detach().contiguous().numpy(), turned.numpy())
    hash_grid.encode(turned.numpy(), table.detach().numpy(), field.sides, field.dense, field.starts, field.mask, out.numpy())
    return turned, out


def _encode_backward(points: Tensor, grad: Tensor, table: Tensor, field: HashField) -> None:
    """Add the gradient of the table for features' gradients (2L, N) at points (3, N) to the field's buffer."""
    from efficientnerf.backends.numba import hash_grid

    accumulator = field.table_gradient.accumulator(table)
    hash_grid.encode_backward(points.numpy(), grad.numpy(), field.sides, field.dense, field.starts, field.mask, accumulator.numpy())


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, table: Tensor, field: HashField) -> Tensor:
        at, out = _encoded(points, table, field)
        ctx.save_for_backward(at)
        ctx.table, ctx.field = table, field
        return out.t()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[None, ...]:
        _encode_backward(ctx.saved_tensors[0], grad.t().contiguous(), ctx.table, ctx.field)
        return None, None, None


class _Network(torch.autograd.Function):
    """Encoding and network: (N, 3) to (N, O), products in `precision`, the logarithm of the density to begin with added to the first output."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, table: Tensor, field: HashField, precision: torch.dtype, *weights: Tensor) -> Tensor:
        from efficientnerf.backends.numba import mlp

        at, features = _encoded(points, table, field)
        prepared = mlp.pack_weights([weight.detach().numpy() for weight in weights], bfloat16=precision == torch.bfloat16)
        out = torch.empty(len(points), len(weights[-1]))
        kept = mlp.forward(features.numpy(), prepared, field.log_initial_density, out.numpy(), keep=any(ctx.needs_input_grad))
        if any(ctx.needs_input_grad):
            ctx.at, ctx.features, ctx.kept, ctx.prepared, ctx.table, ctx.field = at, features, kept, prepared, table, field
            ctx.shapes = [tuple(weight.shape) for weight in weights]
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        from efficientnerf.backends.numba import mlp

        of_features, of_weights = mlp.backward(grad.contiguous().numpy(), ctx.features.numpy(), ctx.prepared, ctx.kept, ctx.shapes)
        ctx.kept = None
        _encode_backward(ctx.at, torch.from_numpy(of_features), ctx.table, ctx.field)
        return None, None, None, None, *map(torch.from_numpy, of_weights)


def encode_reference(points: Tensor, table: Tensor, sides: np.ndarray, dense: np.ndarray, starts: np.ndarray, mask: int) -> Tensor:
    """The encoding in plain torch; runs on any device."""
    columns = []
    corner = torch.stack(torch.meshgrid(*[torch.arange(2, device=points.device)] * 3, indexing="ij"), dim=-1).reshape(8, 3)
    for side, flat, start in zip(sides.tolist(), dense.tolist(), starts.tolist(), strict=True):
        x = points * (side - 1)
        low = x.detach().long().clamp(0, side - 2)
        frac = x - low
        at = low[:, None] + corner  # (N, 8, 3)
        weight = torch.where(corner.bool(), frac[:, None], 1 - frac[:, None]).prod(dim=-1)
        if flat:
            slot = (at[..., 0] * side + at[..., 1]) * side + at[..., 2]
        else:
            wrap = 2**32
            slot = (at[..., 0] ^ (at[..., 1] * int(PRIME_Y) % wrap) ^ (at[..., 2] * int(PRIME_Z) % wrap)) & mask
        columns.append((weight[..., None] * table[start + slot]).sum(dim=1))
    return torch.cat(columns, dim=-1)
