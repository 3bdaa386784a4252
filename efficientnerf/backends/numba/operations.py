"""The numba kernels as operations on float32 tensors of the CPU: the functions that `efficientnerf.backends.dispatch` calls."""

from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.layout import PixelTables, RayBundle, SampleColumns
from efficientnerf.backends.numba import adam as kernel
from efficientnerf.backends.numba import compositing, hash_grid, mlp, occupancy, rays, sampling, sparse_depth
from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.sampling import Box
from efficientnerf.backends.numba.tree import nearest
from efficientnerf.backends.numba.tree.rendering import render_rays
from efficientnerf.backends.torch.hash_grid import HashLevels
from efficientnerf.fields.gradient_buffer import GradientBuffer
from efficientnerf.geometry.spaces import Space
from efficientnerf.rendering.compositing import Composite
from efficientnerf.rendering.harmonics import harmonics_count
from efficientnerf.sampling.samples import Samples


def _array(t: Tensor) -> np.ndarray:
    return (t.detach() if t.requires_grad else t).contiguous().numpy()


def _box(space: Space) -> Box:
    return Box(space.centre.astype(np.float32), space.half.astype(np.float32), space.contracted)


def valid_samples(
    space: Space, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, offset: Tensor, step: float, max_intervals: int,
    voxels: Tensor, threshold: float, *, unpruned: int = 0,
) -> Samples:  # fmt: skip
    bundle = RayBundle(*(_array(t) for t in (origins, directions, near, far, offset)))
    *packed, tried = sampling.valid_samples(bundle, _box(space), step, max_intervals, _array(voxels), threshold, unpruned)
    return Samples._make([*(torch.from_numpy(a) for a in packed), tried, None])


def select_pivots(weight: Tensor, first: Tensor, threshold: float, max_pivots: int) -> Tensor:
    out = torch.empty(len(weight), dtype=torch.bool)
    sampling.select_pivots(_array(weight), _array(first), np.float32(threshold), max_pivots, out.numpy())
    return out


def pivotal_samples(space: Space, origins: Tensor, directions: Tensor, offset: Tensor, coarse: Samples, pivotal: Tensor, per_pivot: int) -> Samples:
    bundle, columns = RayBundle(*map(_array, (origins, directions, offset, offset, offset))), SampleColumns(*map(_array, coarse[1:5]))
    fine = sampling.pivotal_samples(bundle, _box(space), _array(coarse.first), columns, _array(pivotal), per_pivot)
    return Samples._make([*(torch.from_numpy(a) for a in fine), coarse.tried, None])


def visible_samples(samples: Samples, density: Callable[[Tensor], Tensor], activation: str, least: float) -> Samples:
    columns = SampleColumns(*map(_array, samples[1:5]))
    found = sampling.visible_samples(_array(samples.first), columns, lambda points: _array(density(torch.from_numpy(points))), activation == "exp", least)
    return Samples._make([*(torch.from_numpy(a) for a in found), samples.tried, None])


def update_occupancy_maximum(values: Tensor, point: Tensor, raw: Tensor, activation: str, cell: Tensor | None = None) -> None:
    if cell is None:
        cell = torch.empty(len(point), dtype=torch.int32)
        occupancy.cells_of_points(_array(point), values.shape[0], cell.numpy())
    occupancy.update_occupancy_maximum(_array(cell.int()), _array(raw), activation == "exp", values.view(-1).numpy(), numba.get_num_threads())


def random_cells(values: Tensor, threshold: float, count: int, seed: int) -> Tensor:
    cell = np.empty(count, np.int32)
    return torch.from_numpy(cell[: occupancy.random_cells(values.view(-1).numpy(), np.float32(threshold), np.uint64(seed), count - count // 2, cell)])


def points_in_cells(cell: Tensor, side: int, seed: int) -> Tensor:
    point = torch.empty(len(cell), 3)
    occupancy.points_in_cells(_array(cell.int()), side, np.uint64(seed), point.numpy())
    return point


def composite(raw: Tensor, length: Tensor, first: Tensor, harmonics: Tensor, background: Tensor, activation: str) -> Composite:
    """The samples' colours, the lengths and the harmonics carry no gradient."""
    return Composite(*_Composite.apply(raw, length, first, harmonics, background, activation == "exp"))


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, raw: Tensor, length: Tensor, first: Tensor, harmonics: Tensor, background: Tensor, exponential: bool) -> tuple[Tensor, ...]:
        rays = len(first) - 1
        colour, opacity, distortion = torch.empty(rays, 3), torch.empty(rays), torch.empty(rays)
        weight, rgb = torch.empty(len(raw)), torch.empty(len(raw), 3)
        given, out = (raw, length, first, harmonics, background), (colour, opacity, distortion, weight, rgb)
        compositing.composite(*map(_array, given), exponential, *(t.numpy() for t in out))
        ctx.save_for_backward(*given, weight, rgb)
        ctx.exponential = exponential
        ctx.mark_non_differentiable(rgb)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        *given, weight, rgb = ctx.saved_tensors
        grad_raw, grad_background = torch.empty(given[0].shape), torch.empty(given[4].shape)
        arrays = [_array(t) for t in (weight, rgb, *grads[:4])]
        compositing.composite_backward(*map(_array, given), ctx.exponential, *arrays, grad_raw.numpy(), grad_background.numpy())
        return grad_raw, None, None, None, grad_background, None


def scaled_by_distance(values: Tensor, start: Tensor, first: Tensor, subject: Tensor) -> Tensor:
    out = torch.empty(values.shape)
    compositing.scaled_by_distance(*map(_array, (values, start, first, subject)), out.numpy())
    return out


def basis(directions: Tensor, degree: int) -> Tensor:
    out = torch.empty(len(directions), harmonics_count(degree))
    rays.basis(_array(directions), degree, out.numpy())
    return out


def sparse_depth_errors(weight: Tensor, start: Tensor, extent: Tensor, first: Tensor, distance: Tensor, on_support: Tensor, width: float) -> Tensor:
    errors: Tensor = _SparseDepthErrors.apply(weight, start, extent, first, distance, on_support, width)
    return errors


class _SparseDepthErrors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *given: Any) -> Tensor:
        *tensors, width = given
        ctx.arrays, ctx.width, out = [_array(t) for t in tensors], np.float32(width), torch.empty(len(tensors[4]))
        sparse_depth.sparse_depth_errors(*ctx.arrays, ctx.width, out.numpy())
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        grad_weight = torch.zeros(len(ctx.arrays[0]))
        sparse_depth.sparse_depth_errors_backward(_array(grads[0]), *ctx.arrays, ctx.width, grad_weight.numpy())
        return grad_weight, None, None, None, None, None, None


def hash_network(
    points: Tensor, table: Tensor, levels: HashLevels, weights: Sequence[Tensor], offset: float, precision: torch.dtype, gradient: GradientBuffer
) -> Tensor:
    """The gradients of the weights are autograd's; that of the table is added to the buffer `gradient`."""
    return _HashNetwork.apply(points, table, levels, offset, precision, gradient, *weights)


class _HashNetwork(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, points: Tensor, table: Tensor, levels: HashLevels, offset: float, precision: torch.dtype, gradient: GradientBuffer, *weights: Tensor
    ) -> Tensor:
        # Of torch, which aligns them with cache lines.
        at, features = torch.empty(3, len(points)).numpy(), torch.empty(table.shape[1] * len(levels.sides), len(points)).numpy()
        hash_grid.transpose_points(_array(points), at)
        hash_grid.encode(at, table.detach().numpy(), *levels, features)
        prepared = mlp.pack_weights([weight.detach().numpy() for weight in weights], bfloat16=precision == torch.bfloat16)
        out = torch.empty(len(points), len(weights[-1]))
        kept = mlp.forward(features, prepared, offset, out.numpy(), keep=any(ctx.needs_input_grad))
        if any(ctx.needs_input_grad):
            ctx.at, ctx.features, ctx.kept, ctx.prepared = at, features, kept, prepared
            ctx.table, ctx.levels, ctx.gradient = table, levels, gradient
            ctx.shapes = [tuple(weight.shape) for weight in weights]
        return out

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        of_features, of_weights = mlp.backward(grad.contiguous().numpy(), ctx.features, ctx.prepared, ctx.kept, ctx.shapes)
        ctx.kept, levels = None, cast(HashLevels, ctx.levels)
        hash_grid.encode_backward(ctx.at, of_features, *levels, ctx.gradient.accumulator(ctx.table).numpy())
        return None, None, None, None, None, None, *map(torch.from_numpy, of_weights)


def adam(
    value: Tensor, grad: Tensor, first: Tensor, second: Tensor, rate: float, beta1: float, beta2: float, correction1: float, correction2: float,
    epsilon: float, *, skip_zeros: bool,
) -> None:  # fmt: skip
    """Also clears the gradient, where it is contiguous."""
    flat = [t.detach().view(-1).numpy() for t in (value, grad.contiguous(), first, second)]
    kernel.adam(*flat, *(np.float32(x) for x in (rate, beta1, beta2, correction1, correction2, epsilon)), skip_zeros)


def pixel_rays(tables: PixelTables, stride: int, index: Tensor) -> tuple[Tensor, ...]:
    out = torch.empty(len(index), 3), torch.empty(len(index), 3), torch.empty(len(index)), torch.empty(len(index))
    rays.pixel_rays(PixelTables(*map(_array, tables)), stride, _array(index), *(t.numpy() for t in out))
    return out


def tree_rays(
    tree: NerfTree, origins: np.ndarray, directions: np.ndarray, views: np.ndarray | None, eye: np.ndarray | None, columns: int | None
) -> tuple[np.ndarray, ...]:
    if tree.lookup == "nearest":
        return nearest.render_rays(tree, origins, directions, views)

    return render_rays(tree, origins, directions, views, eye, columns)
