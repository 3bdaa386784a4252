"""A multiresolution hash grid (Mueller et al. 2022, "Instant neural graphics primitives") with spherical-harmonics output.

L levels of lattices between `coarsest` and `finest` points a side, two features a lattice point, in tables of 2^log2_table entries (a level that
fits is stored whole, one that does not is hashed); then a small ReLU network. The outputs do not see the direction, so the field bakes.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import torch
from torch import Tensor, nn

from efficientnerf.harmonics import harmonics_count
from efficientnerf.kernels.cpu import PRIME_Y, PRIME_Z
from efficientnerf.kernels.dispatch import on_device

FEATURES = 2


class HashField(nn.Module):
    """hidden x layers ReLU network over 2L features; see `efficientnerf.fields`."""

    activation = "exp"

    def __init__(
        self, *, levels: int, log2_table: int, coarsest: int, finest: int, hidden: int, layers: int, degree: int,
        initial_density: float, generator: torch.Generator,
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
        widths = [levels * FEATURES, *[hidden] * layers, 1 + 3 * harmonics_count(degree)]
        self.weights = nn.ParameterList()
        for inputs, outputs in itertools.pairwise(widths):
            bound = math.sqrt(6 / inputs)  # He initialisation for ReLU
            self.weights.append(nn.Parameter((torch.rand(outputs, inputs, generator=generator) * 2 - 1) * bound))
        # The last layer starts small: grey colours, a density so thin that every ray sees through.
        self.weights[-1].data.mul_(0.1)
        self.log_initial_density = math.log(initial_density)

    def forward(self, points: Tensor) -> Tensor:
        raw = self._network(encode(points, self), self.weights[-1])
        offset = torch.zeros(raw.shape[1], device=raw.device)
        offset[0] = self.log_initial_density
        return raw + offset

    def density(self, points: Tensor) -> Tensor:
        return self._network(encode(points, self), self.weights[-1][:1])[:, 0] + self.log_initial_density

    def _network(self, x: Tensor, last: Tensor) -> Tensor:
        for weight in list(self.weights)[:-1]:
            x = torch.relu(x @ weight.t())
        return x @ last.t()


def encode(points: Tensor, field: HashField) -> Tensor:
    """Features (N, 2L) at points (N, 3) in grid coordinates; differentiable in the table."""
    if points.device.type == "cpu" and points.dtype == torch.float32 and field.table.dtype == torch.float32:
        return _Encode.apply(points, field.table, field)
    if on_device(points, field.table):
        from efficientnerf.kernels import cuda

        return cuda.Encode.apply(points, field.table, field.sides, field.dense, field.starts, int(field.mask))
    return encode_reference(points, field.table, field.sides, field.dense, field.starts, int(field.mask))


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(ctx, points: Tensor, table: Tensor, field: HashField) -> Tensor:  # type: ignore[no-untyped-def]
        from efficientnerf.kernels import cpu

        out = torch.empty(len(points), FEATURES * len(field.sides))
        cpu.encode(points.contiguous().numpy(), table.detach().numpy(), field.sides, field.dense, field.starts, field.mask, out.numpy())
        ctx.save_for_backward(points, table)
        ctx.field = field
        return out

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[None, Tensor, None]:  # type: ignore[no-untyped-def]
        from efficientnerf.kernels import cpu

        points, table = ctx.saved_tensors
        field = ctx.field
        table_grad = torch.zeros_like(table)
        cpu.encode_backward(
            points.contiguous().numpy(), grad.contiguous().numpy(), field.sides, field.dense, field.starts, field.mask, table_grad.numpy()
        )
        return None, table_grad, None


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
