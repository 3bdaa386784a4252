"""The multiresolution hash encoding on CUDA (Triton), forward and backward.

Gradients are summed by atomics, so their last bits depend on the order in which the device runs: on CUDA two runs with one seed agree closely, not to
the byte.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from efficientnerf.backends.torch.hash_grid import HashLevels, relu_network
from efficientnerf.backends.transfer import constant
from efficientnerf.backends.triton.launch import LANES, blocks
from efficientnerf.backends.triton.vectors import Vec3
from efficientnerf.fields.gradient_buffer import GradientBuffer

FEATURES = 2


@triton.jit
def _cells(points, n, live, level, levels):
    """Lower corner and fraction (Vec3 each) of points in a level's grid; and the level's resolution, start in the table and whether it is dense."""
    resolution = tl.load(levels + level * 3).to(tl.int32)
    start = tl.load(levels + level * 3 + 1)
    dense = tl.load(levels + level * 3 + 2).to(tl.int32)
    cells = (resolution - 1).to(tl.float32)
    x = tl.load(points + n * 3, live, other=0.0) * cells
    y = tl.load(points + n * 3 + 1, live, other=0.0) * cells
    z = tl.load(points + n * 3 + 2, live, other=0.0) * cells
    i = tl.minimum(tl.maximum(x.to(tl.int32), 0), resolution - 2)
    j = tl.minimum(tl.maximum(y.to(tl.int32), 0), resolution - 2)
    k = tl.minimum(tl.maximum(z.to(tl.int32), 0), resolution - 2)
    return Vec3(i, j, k), Vec3(x - i.to(tl.float32), y - j.to(tl.float32), z - k.to(tl.float32)), resolution, start, dense


@triton.jit
def _corner(low, fraction, resolution, dense, mask, CORNER: tl.constexpr):
    """Entry in the level's table and trilinear weight of one of the eight corners."""
    p: tl.constexpr = CORNER // 4
    q: tl.constexpr = CORNER // 2 % 2
    s: tl.constexpr = CORNER % 2
    weight = (fraction.x if p else 1 - fraction.x) * (fraction.y if q else 1 - fraction.y) * (fraction.z if s else 1 - fraction.z)
    x, y, z = low.x + p, low.y + q, low.z + s
    if dense != 0:
        entry = (x * resolution + y) * resolution + z
    else:
        # The primes of Mueller et al. 2022, section 3.
        hashed = x.to(tl.uint32) ^ (y.to(tl.uint32) * 2654435761) ^ (z.to(tl.uint32) * 805459861)
        entry = (hashed & mask.to(tl.uint32)).to(tl.int32)
    return entry, weight


@triton.jit(do_not_specialize=["samples"])
def _encode(points, table, levels, out, samples, mask, L: tl.constexpr, BLOCK: tl.constexpr):
    """One program: a block of samples at one level. An entry's two features are one load of eight bytes."""
    level = tl.program_id(1)
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = n < samples
    feature = tl.arange(0, 2)
    low, fraction, resolution, start, dense = _cells(points, n, live, level, levels)
    total = tl.zeros((BLOCK, 2), tl.float32)
    for corner in tl.static_range(8):
        entry, weight = _corner(low, fraction, resolution, dense, mask, corner)
        total += weight[:, None] * tl.load(table + start * 2 + (entry[:, None] * 2 + feature[None, :]), live[:, None], other=0.0)
    tl.store(out + (n[:, None] * (2 * L) + level * 2 + feature[None, :]), total, live[:, None])


@triton.jit(do_not_specialize=["samples"])
def _encode_backward(points, grad, levels, table_grad, samples, mask, L: tl.constexpr, BLOCK: tl.constexpr):
    level = tl.program_id(1)
    n = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = n < samples
    feature = tl.arange(0, 2)
    g = tl.load(grad + (n[:, None] * (2 * L) + level * 2 + feature[None, :]), live[:, None], other=0.0)
    low, fraction, resolution, start, dense = _cells(points, n, live, level, levels)
    nonzero = (tl.max(tl.abs(g), 1) > 0)[:, None]
    for corner in tl.static_range(8):
        entry, weight = _corner(low, fraction, resolution, dense, mask, corner)
        # Samples without a gradient (behind an opaque surface, or padding) cost no traffic.
        tl.atomic_add(table_grad + start * 2 + (entry[:, None] * 2 + feature[None, :]), weight[:, None] * g, mask=nonzero, sem="relaxed")


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, table: Tensor, levels: HashLevels) -> Tensor:
        points, count, mask = points.detach().contiguous(), len(levels.sides), int(levels.mask)
        on_device = constant(np.stack([levels.sides, levels.starts, levels.dense], axis=1), points.new_empty(0, dtype=torch.int64))
        out = torch.empty(len(points), FEATURES * count, device=points.device)
        _encode[(blocks(len(points)), count)](points, table.detach(), on_device, out, len(points), mask, L=count, BLOCK=LANES)
        ctx.save_for_backward(points, on_device)
        ctx.size, ctx.mask = table.shape, mask
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        points, levels = ctx.saved_tensors
        table_grad = torch.zeros(ctx.size, device=points.device)
        grad = grads[0].contiguous()
        _encode_backward[(blocks(len(points)), len(levels))](points, grad, levels, table_grad, len(points), ctx.mask, L=len(levels), BLOCK=LANES)
        return None, table_grad, None


def encode(points: Tensor, table: Tensor, levels: HashLevels) -> Tensor:
    """`efficientnerf.backends.torch.hash_grid.encode` with two features an entry; differentiable in the table."""
    return _Encode.apply(points, table, levels)


def hash_network(
    points: Tensor, table: Tensor, levels: HashLevels, weights: Sequence[Tensor], offset: float, precision: torch.dtype, gradient: GradientBuffer | None = None
) -> Tensor:
    """`efficientnerf.backends.torch.hash_grid.hash_network` with this encoding."""
    return relu_network(encode(points, table, levels), weights, offset, precision)
