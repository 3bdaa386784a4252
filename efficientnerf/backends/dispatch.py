"""The kernels under the signatures of the torch functions they replace: numba for float32 on the CPU, Triton for float32 on CUDA, else the torch
function itself.
"""

from __future__ import annotations

import functools
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from efficientnerf.geometry.spaces import Space
from efficientnerf.rendering import compositing
from efficientnerf.rendering.compositing import Composite
from efficientnerf.sampling import pivotal as pivotal_sampling
from efficientnerf.sampling import valid as valid_sampling
from efficientnerf.sampling.samples import Samples

if TYPE_CHECKING:
    from efficientnerf.asset.tree import NerfTree


def _fast(*tensors: Tensor) -> bool:
    return all(t.device.type == "cpu" and t.dtype == torch.float32 for t in tensors)


def on_device(*tensors: Tensor) -> bool:
    """Whether the Triton kernels take these tensors: float32 on CUDA, and they can be built here."""
    return all(t.is_cuda and t.dtype == torch.float32 for t in tensors) and triton_usable()


@functools.cache
def triton_usable() -> bool:
    """Whether Triton's kernels can be built and launched here; warns once, with the remedy, where there is CUDA and they cannot."""
    if not torch.cuda.is_available():
        return False
    try:
        from efficientnerf.backends.triton.adam import adam
    except ImportError as error:
        warnings.warn(f"Triton cannot be imported ({error}); plain torch is used on CUDA, many times slower. Install triton.", RuntimeWarning, stacklevel=3)
        return False
    try:
        probe = torch.ones(1, device="cuda")
        adam(probe, probe.clone(), probe.clone(), probe.clone(), 0.0, 0.9, 0.99, 1.0, 1.0, 1e-8, skip_zeros=False)
    except Exception as error:  # whatever the compiler, the driver or the launcher may say
        reason = str(error).strip().splitlines()[-1:] or [type(error).__name__]
        warnings.warn(
            f"The CUDA kernels cannot be built here ({reason[0][:200]}); plain torch is used, many times slower. Usually a C compiler is missing: install gcc.",
            RuntimeWarning,
            stacklevel=2,
        )
        return False
    return True


def _refuse(capacity: int | None) -> None:
    if capacity is not None:
        raise ValueError(f"capacity {capacity}: only the kernels on CUDA pad their samples; elsewhere their number is known")


def _array(t: Tensor) -> np.ndarray:
    return t.detach().contiguous().numpy()


def _box(space: Space) -> tuple[np.ndarray, np.ndarray, bool]:
    return space.centre.astype(np.float32), space.half.astype(np.float32), space.contracted


def valid_samples(
    space: Space, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, offset: Tensor, step: float, slots: int, voxels: Tensor, threshold: float,
    capacity: int | None = None, *, whole: int = 0,
) -> Samples:  # fmt: skip
    """See `efficientnerf.sampling.valid.valid_samples`; `capacity` is for the Triton kernels alone, see `efficientnerf.backends.triton.sampling`."""
    if on_device(origins, directions, near, far, offset, voxels):
        from efficientnerf.backends.triton import sampling as cuda_sampling

        return cuda_sampling.valid_samples(space, origins, directions, near, far, offset, step, slots, voxels, threshold, capacity, whole=whole)
    _refuse(capacity)
    if not _fast(origins, directions, near, far, offset, voxels):
        return valid_sampling.valid_samples(space, origins, directions, near, far, offset, step, slots, voxels, threshold, whole=whole)
    from efficientnerf.backends.numba import sampling as cpu

    *packed, tried = cpu.valid_samples(
        _array(origins), _array(directions), _array(near), _array(far), _array(offset), *_box(space), step, slots, _array(voxels), threshold, whole
    )
    return Samples._make([*(torch.from_numpy(a) for a in packed), tried, None])


def update_occupancy_maximum(values: Tensor, point: Tensor, raw: Tensor, activation: str) -> bool:
    """What `efficientnerf.sampling.occupancy.update` does under "maximum", with samples at `point` (N, 3) in grid coordinates

    False where there is no kernel for it."""
    if not _fast(values, point, raw):
        return False
    from efficientnerf.backends.numba import occupancy as cpu

    cpu.update_occupancy(_array(point), raw.detach().numpy(), activation == "exp", values.numpy())
    return True


def select_pivots(weight: Tensor, first: Tensor, threshold: float, most: int) -> Tensor:
    """See `efficientnerf.sampling.pivotal.select_pivots`."""
    if on_device(weight):
        from efficientnerf.backends.triton import sampling as cuda_sampling

        return cuda_sampling.select_pivots(weight, first, threshold, most)
    if not _fast(weight):
        return pivotal_sampling.select_pivots(weight, first, threshold, most)
    from efficientnerf.backends.numba import sampling as cpu

    out = torch.empty(len(weight), dtype=torch.bool)
    cpu.select_pivots(_array(weight), _array(first), np.float32(threshold), most, out.numpy())
    return out


def pivotal_samples(
    space: Space, origins: Tensor, directions: Tensor, offset: Tensor, coarse: Samples, pivotal: Tensor, per_pivot: int, capacity: int | None = None
) -> Samples:
    """See `efficientnerf.sampling.pivotal.pivotal_samples`; `capacity` as for `valid_samples`."""
    if on_device(origins, directions, offset, coarse.start):
        from efficientnerf.backends.triton import sampling as cuda_sampling

        return cuda_sampling.pivotal_samples(space, origins, directions, offset, coarse, pivotal, per_pivot, capacity)
    _refuse(capacity)
    if not _fast(origins, directions, offset, coarse.start):
        return pivotal_sampling.pivotal_samples(space, origins, directions, offset, coarse, pivotal, per_pivot)
    from efficientnerf.backends.numba import sampling as cpu

    fine = cpu.pivotal_samples(
        _array(origins), _array(directions), _array(offset), *_box(space),
        _array(coarse.first), _array(coarse.start), _array(coarse.extent), _array(coarse.length), _array(pivotal), per_pivot,
    )  # fmt: skip
    return Samples._make([*(torch.from_numpy(a) for a in fine), coarse.tried, None])


def tree_rays(
    tree: NerfTree,
    origins: np.ndarray,
    directions: np.ndarray,
    looking: np.ndarray | None = None,
    eye: np.ndarray | None = None,
    columns: int | None = None,
) -> tuple[np.ndarray, ...]:
    """Colour, opacity, distance and normal of rays of a tree's frame, where the tree lies; see `backends.numba.tree.rendering.render_rays`."""
    if tree.device != "cpu" and triton_usable():
        from efficientnerf.backends.triton import tree as cuda_tree

        given = (origins, directions) if looking is None else (origins, directions, looking)
        there = [torch.from_numpy(np.ascontiguousarray(a, np.float64)).to(tree.device) for a in given]
        return tuple(part.cpu().numpy() for part in cuda_tree.render_rays(cuda_tree.device_tree_of(tree), *there))
    if tree.lookup == "nearest":
        from efficientnerf.backends.numba.tree import nearest

        return nearest.render_rays(tree, origins, directions, looking)
    from efficientnerf.backends.numba.tree.rendering import render_rays

    return render_rays(tree, origins, directions, looking, eye, columns)


def composite(raw: Tensor, length: Tensor, first: Tensor, harmonics: Tensor, background: Tensor, activation: str) -> Composite:
    """See `efficientnerf.rendering.compositing.composite`; by kernels the samples' colours, the lengths and the harmonics carry no gradient."""
    if on_device(raw, length, harmonics, background):
        from efficientnerf.backends.triton import compositing as cuda_compositing

        return cuda_compositing.composite(raw, length, first, harmonics, background, activation)
    if not _fast(raw, length, harmonics, background):
        return compositing.composite(raw, length, first, harmonics, background, activation)
    return Composite(*_Composite.apply(raw, length, first, harmonics, background, activation == "exp"))


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, raw: Tensor, length: Tensor, first: Tensor, harmonics: Tensor, background: Tensor, exponential: bool) -> tuple[Tensor, ...]:
        from efficientnerf.backends.numba import compositing as cpu

        rays = len(first) - 1
        colour, opacity, distortion = torch.empty(rays, 3), torch.empty(rays), torch.empty(rays)
        weight, rgb = torch.empty(len(raw)), torch.empty(len(raw), 3)
        cpu.composite(
            _array(raw), _array(length), _array(first), _array(harmonics), _array(background), exponential,
            colour.numpy(), opacity.numpy(), distortion.numpy(), weight.numpy(), rgb.numpy(),
        )  # fmt: skip
        ctx.save_for_backward(raw, length, first, harmonics, background, weight, rgb)
        ctx.exponential = exponential
        ctx.mark_non_differentiable(rgb)
        return colour, opacity, distortion, weight, rgb

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        from efficientnerf.backends.numba import compositing as cpu

        raw, length, first, harmonics, background, weight, rgb = ctx.saved_tensors
        grad_raw, grad_background = torch.empty(raw.shape), torch.empty(background.shape)
        cpu.composite_backward(
            *(_array(t) for t in (raw, length, first, harmonics, background)), ctx.exponential, _array(weight), _array(rgb),
            _array(grads[0]), _array(grads[1]), _array(grads[2]), _array(grads[3]), grad_raw.numpy(), grad_background.numpy(),
        )  # fmt: skip
        return grad_raw, None, None, None, grad_background, None
