"""Structure of a tree as its training's kernels read it (numba): all cascades in the same arrays, and densities brick by brick.

N stored voxels, L cascades, C coarse cells of all cascades.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.tree.walk import TreeGrid
from efficientnerf.backends.numba.vector.memory import pointer


class Cells(NamedTuple):
    """Structure of a tree, all cascades alike; see `TreeGrid`.

    step         distance between samples, voxels
    step_length  the same in cascade 0, units of the frame
    brick_index  (C,) int32, leap (C,) uint8
    shape        (L, 3) int64 coarse cells
    first        (L,) int64 where a cascade's cells begin
    corner       (L, 3) float64, voxels of cascade 0
    scale        (L,) float64 side of a voxel, voxels of cascade 0
    """

    brick: int
    nearest: bool
    step: float
    step_length: float
    voxel_index: np.ndarray
    brick_index: np.ndarray
    leap: np.ndarray
    shape: np.ndarray
    first: np.ndarray
    corner: np.ndarray
    scale: np.ndarray


class TreePointers(NamedTuple):
    """Cells with arrays as pointers; `cascades` L, `cube` voxels of a brick, `inverse` of the brick's side, `absent` where densities of bricks that are not
    stored begin, `one` in the densities' type, and `density` those of `dense_densities`."""

    brick: int
    cube: int
    absent: int
    inverse: float
    nearest: bool
    step: float
    step_length: float
    one: Any
    cascades: int
    voxel_index: Any
    brick_index: Any
    leap: Any
    shape: Any
    first: Any
    corner: Any
    scale: Any
    density: Any


def cells_of(grid: TreeGrid) -> Cells:
    """All cascades of a tree's structure in the same arrays."""
    shape = np.concatenate([np.asarray([grid.brick_index.shape], np.int64), grid.outer_shape])
    first = np.concatenate([np.zeros(1, np.int64), grid.brick_index.size + grid.outer_first])
    several = len(grid.outer_first) > 0
    index = np.concatenate([grid.brick_index.reshape(-1), grid.outer_brick_index]) if several else np.ascontiguousarray(grid.brick_index).reshape(-1)
    leap = np.concatenate([grid.leap.reshape(-1), grid.outer_leap]) if several else np.ascontiguousarray(grid.leap).reshape(-1)
    corner, scale = np.concatenate([np.zeros((1, 3)), grid.outer_corner]), np.concatenate([np.ones(1), grid.outer_scale])
    return Cells(grid.brick, grid.nearest, grid.step, grid.step_length, np.ascontiguousarray(grid.voxel_index), index, leap, shape, first, corner, scale)


def voxel_places(cells: Cells, voxels: int) -> np.ndarray:
    """(N,) int64: where each of so many voxels is in `Cells.voxel_index`, brick by brick."""
    flat = cells.voxel_index.reshape(-1)
    stored = np.flatnonzero(flat >= 0)
    places = np.zeros(voxels, np.int64)
    places[flat[stored]] = stored
    return places


def dense_densities(cells: Cells, places: np.ndarray, density: np.ndarray) -> np.ndarray:
    """Densities of all voxels of all bricks, -0 where none is stored, with a brick of these at the end."""
    dense = np.full(cells.voxel_index.size + cells.brick**3, -0.0, density.dtype)
    dense[places] = density
    return dense


@numba.njit(cache=True, inline="always", error_model="numpy")
def tree_pointers(cells, density):  # type: ignore[no-untyped-def]
    """See `TreePointers`."""
    return TreePointers(
        cells.brick, cells.brick * cells.brick * cells.brick, cells.voxel_index.size, 1.0 / cells.brick, cells.nearest, cells.step, cells.step_length,
        density.dtype.type(1), len(cells.first), pointer(cells.voxel_index), pointer(cells.brick_index), pointer(cells.leap), pointer(cells.shape),
        pointer(cells.first), pointer(cells.corner), pointer(cells.scale), pointer(density),
    )  # fmt: skip
