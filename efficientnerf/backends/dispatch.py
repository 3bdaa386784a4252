"""Operations that have an implementation in each backend, and the one table that chooses among them by the tensors' device and type.

    torch   the reference: any device and type
    numba   float32 on the CPU
    triton  float32 on CUDA, where its kernels can be built

An operation that has no kernel in the backend of its tensors is done by torch. Rays of trees are chosen by the tree's device; their torch reference,
of colour and opacity alone, is `tests.efficientnerf.tree_reference`. A new operation is a function of the same name in a module of each
backend, a line of OPERATIONS, a function here, and a case in tests/efficientnerf/backends/test_operations.py.
"""

import functools
import importlib
import warnings
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends import Notice
from efficientnerf.backends.layout import PixelTables
from efficientnerf.backends.torch.hash_grid import HashLevels
from efficientnerf.fields.gradient_buffer import GradientBuffer
from efficientnerf.geometry.spaces import Space
from efficientnerf.rendering.compositing import Composite
from efficientnerf.sampling.samples import Samples

Backend = Literal["torch", "numba", "triton"]

# The module, within this package, that has a function of the operation's name.
OPERATIONS: dict[str, dict[Backend, str]] = {
    "valid_samples": {"torch": "sampling.valid", "numba": "backends.numba.operations", "triton": "backends.triton.sampling"},
    "select_pivots": {"torch": "sampling.pivotal", "numba": "backends.numba.operations", "triton": "backends.triton.sampling"},
    "pivotal_samples": {"torch": "sampling.pivotal", "numba": "backends.numba.operations", "triton": "backends.triton.sampling"},
    "visible_samples": {"torch": "sampling.visible", "numba": "backends.numba.operations"},
    "composite": {"torch": "rendering.compositing", "numba": "backends.numba.operations", "triton": "backends.triton.compositing"},
    "scaled_by_distance": {"torch": "rendering.compositing", "numba": "backends.numba.operations"},
    "basis": {"torch": "rendering.harmonics", "numba": "backends.numba.operations"},
    "sparse_depth_errors": {"torch": "backends.torch.sparse_depth", "numba": "backends.numba.operations"},
    "hash_network": {"torch": "backends.torch.hash_grid", "numba": "backends.numba.operations", "triton": "backends.triton.hash_grid"},
    "update_occupancy_maximum": {"torch": "backends.torch.occupancy", "numba": "backends.numba.operations"},
    "random_cells": {"torch": "backends.torch.occupancy", "numba": "backends.numba.operations"},
    "points_in_cells": {"torch": "backends.torch.occupancy", "numba": "backends.numba.operations"},
    "adam": {"torch": "backends.torch.adam", "numba": "backends.numba.operations", "triton": "backends.triton.adam"},
    "pixel_rays": {"torch": "backends.torch.rays", "numba": "backends.numba.operations"},
    "tree_rays": {"numba": "backends.numba.operations", "triton": "backends.triton.tree"},
}
# The module whose `Steps`, `losses_of` and `max_weights` fit trees to photographs; see `efficientnerf.asset.refinement.fit`.
FITTING: dict[Backend, str] = {"numba": "asset.refinement.host", "triton": "asset.refinement.device"}
# The module whose `splat_image` renders 3D Gaussians, and whose `SplatFit` fits them to pictures.
SPLATS: dict[Backend, str] = {"numba": "backends.numba.splats.fit", "triton": "backends.triton.splats.fit"}


def backend_of(*tensors: Tensor) -> Backend:
    """The backend for tensors that are used together."""
    if all(t.dtype == torch.float32 for t in tensors):
        if all(t.device.type == "cpu" for t in tensors):
            return "numba"
        if all(t.is_cuda for t in tensors) and triton_usable():
            return "triton"
    return "torch"


def on_device(*tensors: Tensor) -> bool:
    """Whether the Triton kernels take these tensors."""
    return backend_of(*tensors) == "triton"


def implementation(name: str, backend: Backend) -> Callable[..., Any]:
    """The function of a backend, or torch's where it has none."""
    modules = OPERATIONS[name]
    return _function(modules[backend] if backend in modules else modules["torch"], name)


@functools.cache
def _function(module: str, name: str) -> Callable[..., Any]:
    function: Callable[..., Any] = getattr(importlib.import_module(f"efficientnerf.{module}"), name)
    return function


def fitting(backend: Backend) -> Any:
    """The module of FITTING."""
    return importlib.import_module(f"efficientnerf.{FITTING[backend]}")


def splats_on(device: str) -> Any:
    """The module of SPLATS for "cpu" or "cuda"; on the CPU where the kernels of the device cannot be built."""
    return importlib.import_module(f"efficientnerf.{SPLATS['triton' if device != 'cpu' and triton_usable() else 'numba']}")


@functools.cache
def triton_usable() -> bool:
    """Whether Triton's kernels can be built and launched here; warns once, with the remedy, if CUDA is there and they cannot.

    Triton's launcher is compiled by the system's C compiler.
    """
    if not torch.cuda.is_available():
        return False
    try:
        from efficientnerf.backends.triton.adam import adam as probe  # whether Triton is there is found out here
    except ImportError as error:
        warnings.warn(f"Triton cannot be imported ({error}); plain torch is used on CUDA, many times slower. Install triton.", Notice, stacklevel=3)
        return False
    try:
        one = torch.ones(1, device="cuda")
        probe(one, one.clone(), one.clone(), one.clone(), 0.0, 0.9, 0.99, 1.0, 1.0, 1e-8, skip_zeros=False)
    except Exception as error:  # whatever the compiler, the driver or the launcher may raise
        reason = str(error).strip().splitlines()[-1:] or [type(error).__name__]
        warnings.warn(
            f"The CUDA kernels cannot be built here ({reason[0][:200]}); plain torch is used, many times slower. Usually a C compiler is missing: install gcc.",
            Notice,
            stacklevel=3,
        )
        return False
    return True


def _capacity(backend: Backend, capacity: int | None) -> dict[str, int | None]:
    if backend == "triton":
        return {"capacity": capacity}
    if capacity is not None:
        raise ValueError(f"capacity {capacity}: only the kernels on CUDA pad their samples; elsewhere their number is known")
    return {}


def valid_samples(
    space: Space, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, offset: Tensor, step: float, max_intervals: int,
    voxels: Tensor, threshold: float, capacity: int | None = None, *, unpruned: int = 0,
) -> Samples:  # fmt: skip
    """See `efficientnerf.sampling.valid.valid_samples`; `capacity` is for Triton alone, see `efficientnerf.backends.triton.sampling`."""
    rays = (origins, directions, near, far, offset)
    backend = backend_of(*rays, voxels)
    find = implementation("valid_samples", backend)
    return find(space, *rays, step, max_intervals, voxels, threshold, unpruned=unpruned, **_capacity(backend, capacity))


def select_pivots(weight: Tensor, first: Tensor, threshold: float, max_pivots: int) -> Tensor:
    """See `efficientnerf.sampling.pivotal.select_pivots`."""
    return implementation("select_pivots", backend_of(weight))(weight, first, threshold, max_pivots)


def pivotal_samples(
    space: Space, origins: Tensor, directions: Tensor, offset: Tensor, coarse: Samples, pivotal: Tensor, per_pivot: int, capacity: int | None = None
) -> Samples:
    """See `efficientnerf.sampling.pivotal.pivotal_samples`; `capacity` as for `valid_samples`."""
    backend = backend_of(origins, directions, offset, coarse.start)
    divide = implementation("pivotal_samples", backend)
    return divide(space, origins, directions, offset, coarse, pivotal, per_pivot, **_capacity(backend, capacity))


def visible_samples(samples: Samples, density: Callable[[Tensor], Tensor], activation: str, least: float) -> Samples:
    """See `efficientnerf.sampling.visible.visible_samples`."""
    return implementation("visible_samples", backend_of(samples.start))(samples, density, activation, least)


def composite(raw: Tensor, length: Tensor, first: Tensor, harmonics: Tensor, background: Tensor, activation: str) -> Composite:
    """See `efficientnerf.rendering.compositing.composite`; but for torch the samples' colours, the lengths and the harmonics carry no gradient."""
    return implementation("composite", backend_of(raw, length, harmonics, background))(raw, length, first, harmonics, background, activation)


def scaled_by_distance(values: Tensor, start: Tensor, first: Tensor, subject: Tensor) -> Tensor:
    """See `efficientnerf.rendering.compositing.scaled_by_distance`."""
    return implementation("scaled_by_distance", backend_of(values, start, subject))(values, start, first, subject)


def basis(directions: Tensor, degree: int) -> Tensor:
    """See `efficientnerf.rendering.harmonics.basis`; without gradients but for torch."""
    return implementation("basis", backend_of(directions))(directions, degree)


def sparse_depth_errors(weight: Tensor, start: Tensor, extent: Tensor, first: Tensor, distance: Tensor, on_support: Tensor, width: float) -> Tensor:
    """See `efficientnerf.backends.torch.sparse_depth.sparse_depth_errors`."""
    errors = implementation("sparse_depth_errors", backend_of(weight, start, extent, distance))
    return errors(weight, start, extent, first, distance, on_support, width)


def hash_network(
    points: Tensor, table: Tensor, levels: HashLevels, weights: Sequence[Tensor], offset: float, precision: torch.dtype, gradient: GradientBuffer
) -> Tensor:
    """See `efficientnerf.backends.torch.hash_grid.hash_network`. With numba the gradient of the table is added to the buffer, not handed to autograd."""
    return implementation("hash_network", backend_of(points, table))(points, table, levels, weights, offset, precision, gradient)


def update_occupancy_maximum(values: Tensor, point: Tensor, raw: Tensor, activation: str, cell: Tensor | None = None) -> None:
    """See `efficientnerf.backends.torch.occupancy.update_occupancy_maximum`."""
    implementation("update_occupancy_maximum", backend_of(values, point, raw))(values, point, raw, activation, cell)


def random_cells(values: Tensor, threshold: float, count: int, seed: int) -> Tensor:
    """See `efficientnerf.backends.torch.occupancy.random_cells`; the numbers drawn are those of the backend."""
    return implementation("random_cells", backend_of(values))(values, threshold, count, seed)


def points_in_cells(cell: Tensor, side: int, seed: int) -> Tensor:
    """See `efficientnerf.backends.torch.occupancy.points_in_cells`; the numbers drawn are those of the backend."""
    return implementation("points_in_cells", "numba" if cell.device.type == "cpu" else "torch")(cell, side, seed)


def adam(
    value: Tensor, grad: Tensor, first: Tensor, second: Tensor, rate: float | Tensor, beta1: float, beta2: float, correction1: float | Tensor,
    correction2: float | Tensor, epsilon: float, *, skip_zeros: bool,
) -> None:  # fmt: skip
    """See `efficientnerf.backends.torch.adam.adam`; numba also clears the gradient. Tensors of one value in place of floats are for Triton alone."""
    step = implementation("adam", backend_of(value, grad))
    step(value, grad, first, second, rate, beta1, beta2, correction1, correction2, epsilon, skip_zeros=skip_zeros)


def pixel_rays(tables: PixelTables, stride: int, index: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """See `efficientnerf.backends.torch.rays.pixel_rays`."""
    found: tuple[Tensor, Tensor, Tensor, Tensor] = implementation("pixel_rays", backend_of(tables.lookup, tables.rotation))(tables, stride, index)
    return found


def tree_backend(tree: NerfTree) -> Backend:
    """The backend that renders a tree."""
    return "triton" if tree.device != "cpu" and triton_usable() else "numba"


def tree_rays(
    tree: NerfTree, origins: np.ndarray, directions: np.ndarray, views: np.ndarray | None = None, eye: np.ndarray | None = None, columns: int | None = None
) -> tuple[np.ndarray, ...]:
    """Colour (R, 3), premultiplied, of the voxels alone, opacity (R,), distance (R,) and normal (R, 3) of rays of a tree's frame.

    views    (R, 3) directions of the world that colours are looked up along; None: `directions`
    eye      the origin of all rays, columns: of the image that they are the pixels of; where known, for speed alone
    """
    return implementation("tree_rays", tree_backend(tree))(tree, origins, directions, views, eye, columns)
