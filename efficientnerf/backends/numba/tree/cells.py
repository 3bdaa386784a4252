"""Structure of a tree as kernels read it (numba), all cascades in the same arrays; and which voxels it stores where.

N stored voxels, L cascades, C coarse cells of all cascades.
"""

from typing import Any, NamedTuple

import numpy as np

from efficientnerf.asset.tree import Cascade, NerfTree
from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.tree.leaps import leaps


class Cells(NamedTuple):
    """Structure of a tree, all cascades alike, see `NerfTree`; in kernels, which call it `tree`, its arrays are pointers."""

    brick: int
    cube: int  # voxels of a brick
    inverse: float  # of the brick's side
    nearest: bool
    step: float  # distance between samples, voxels
    step_length: float  # the same in cascade 0, units of the frame
    cascades: int  # L
    absent: int  # where the densities of bricks that are not stored begin in `dense_densities`
    voxel_index: np.ndarray
    brick_index: np.ndarray  # (C,) int32
    leap: np.ndarray  # (C,) uint8
    shape: np.ndarray  # (L, 3) int64 coarse cells
    first: np.ndarray  # (L,) int64 where a cascade's cells begin
    corner: np.ndarray  # (L, 3) float64, voxels of cascade 0
    scale: np.ndarray  # (L,) float64 side of a voxel, voxels of cascade 0
    density: Any = None  # where there are any: those of `dense_densities`, or (N,), as callers say
    one: Any = None  # 1 in their type

    def having(self, density: np.ndarray) -> "Cells":
        """The structure with densities."""
        return self._replace(density=density, one=density.dtype.type(1))


def cells_of(tree: NerfTree) -> Cells:
    """The structure of a tree, kept with it."""
    if "cells" not in tree.derived:
        outer, step = tree.outer, float(tree.step_size)
        index, leap = [tree.brick_index, *(cascade.brick_index for cascade in outer)], [tree.leap, *(leaps(cascade.brick_index >= 0) for cascade in outer)]
        corner = np.stack([np.zeros(3), *((cascade.bounds_min - tree.bounds_min) / tree.voxel for cascade in outer)])
        scale = np.asarray([1.0, *(cascade.voxel / tree.voxel for cascade in outer)])
        tree.derived["cells"] = _cells(tree, step, float(step * tree.voxel), index, leap, corner, scale)
    return tree.derived["cells"]


def cascade_cells(tree: NerfTree, cascade: Cascade) -> Cells:
    """The structure of one cascade, in its own voxels, without leaps."""
    return _cells(tree, 1.0, float(cascade.voxel), [cascade.brick_index], [np.zeros(1, np.uint8)], np.zeros((1, 3)), np.ones(1))


def _cells(
    tree: NerfTree, step: float, step_length: float, index: list[np.ndarray], leap: list[np.ndarray], corner: np.ndarray, scale: np.ndarray
) -> Cells:
    sizes, brick, voxels = [each.size for each in index], tree.brick, np.ascontiguousarray(tree.voxel_index)
    return Cells(
        brick, brick**3, 1.0 / brick, tree.lookup == "nearest", step, step_length, len(index), voxels.size, voxels, _end_to_end(index, np.int32),
        _end_to_end(leap, np.uint8), np.asarray([each.shape for each in index], np.int64), np.cumsum([0, *sizes[:-1]]).astype(np.int64), corner, scale,
    )  # fmt: skip


def _end_to_end(arrays: list[np.ndarray], kind: type) -> np.ndarray:
    """Flat; a single array is not copied."""
    return np.ascontiguousarray(arrays[0], kind).reshape(-1) if len(arrays) == 1 else np.concatenate([each.reshape(-1) for each in arrays]).astype(kind)


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
def stored_voxel(i, j, k, cascade, tree):
    """Index of the stored voxel (i, j, k) of a cascade, or -1."""
    if i < 0 or j < 0 or k < 0:
        return np.int32(-1)
    brick = tree.brick
    a, b, c = i // brick, j // brick, k // brick
    ny, nz = tree.shape[3 * cascade + 1], tree.shape[3 * cascade + 2]
    if a >= tree.shape[3 * cascade] or b >= ny or c >= nz:
        return np.int32(-1)
    owner = np.int64(tree.brick_index[tree.first[cascade] + (a * ny + b) * nz + c])
    if owner < 0:
        return np.int32(-1)
    return np.int32(tree.voxel_index[owner * tree.cube + ((i - a * brick) * brick + (j - b * brick)) * brick + (k - c * brick)])


@numba.njit(cache=True, error_model="numpy")
def corner_voxels(i, j, k, cascade, tree, index):
    """The stored voxels (i or i + 1, j or j + 1, k or k + 1), z fastest, into `index` (8,); -1 where there is none."""
    brick = tree.brick
    li, lj, lk = i % brick, j % brick, k % brick
    if i >= 0 and j >= 0 and k >= 0 and li < brick - 1 and lj < brick - 1 and lk < brick - 1:
        # All eight in one brick: one lookup in the coarse level.
        a, b, c = i // brick, j // brick, k // brick
        ny, nz = tree.shape[3 * cascade + 1], tree.shape[3 * cascade + 2]
        owner = np.int64(-1)
        if a < tree.shape[3 * cascade] and b < ny and c < nz:
            owner = np.int64(tree.brick_index[tree.first[cascade] + (a * ny + b) * nz + c])
        first = owner * tree.cube + (li * brick + lj) * brick + lk
        for n in range(8):
            index[n] = tree.voxel_index[first + ((n >> 2) * brick + ((n >> 1) & 1)) * brick + (n & 1)] if owner >= 0 else -1
        return
    for n in range(8):
        index[n] = stored_voxel(i + (n >> 2), j + ((n >> 1) & 1), k + (n & 1), cascade, tree)


@numba.njit(cache=True, inline="always", error_model="numpy")
def corner_weight(n, fx, fy, fz):
    """Trilinear weight of corner n."""
    return (fx if n & 4 else 1 - fx) * (fy if n & 2 else 1 - fy) * (fz if n & 1 else 1 - fz)
