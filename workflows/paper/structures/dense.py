"""Dense voxels: one packed value for each voxel of the grid, x slowest; zero where it is empty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from workflows.paper.structures.bits import CHUNK, TASK, ZERO, fill, floor_to_uint64, in_grid
from workflows.paper.structures.voxels import Voxels


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _store(coordinates, packed, side, grid):  # type: ignore[no-untyped-def]
    n = len(packed)
    for task in numba.prange((n + TASK - 1) // TASK):
        for i in range(task * TASK, min(n, (task + 1) * TASK)):
            grid[(floor_to_uint64(coordinates[i, 0]) * side + floor_to_uint64(coordinates[i, 1])) * side + floor_to_uint64(coordinates[i, 2])] = packed[i]


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _query(points, side, grid, packed, occupied):  # type: ignore[no-untyped-def]
    n, top, outside = len(points), np.float32(side), np.uint64(len(grid) - 1)
    for task in numba.prange((n + TASK - 1) // TASK):
        where = np.empty(CHUNK, np.uint64)
        for begin in range(task * TASK, min(n, (task + 1) * TASK), CHUNK):
            end = min(begin + CHUNK, n)
            point, word, there = points[begin:end], packed[begin:end], occupied[begin:end]
            size = np.uint64(end - begin)
            for i in range(size):
                x, y, z = point[i, 0], point[i, 1], point[i, 2]
                where[i] = (floor_to_uint64(x) * side + floor_to_uint64(y)) * side + floor_to_uint64(z) if in_grid(x, y, z, top) else outside
            for i in range(size):
                word[i] = grid[where[i]]
                there[i] = word[i] != ZERO


@dataclass(frozen=True, eq=False)
class DenseVoxels:
    """side voxels along each side; grid (side^3 + 1,) uint64, the last of them zero, for points outside."""

    side: int
    grid: np.ndarray

    @staticmethod
    def cache(voxels: Voxels) -> DenseVoxels:
        grid = np.empty(voxels.side**3 + 1, np.uint64)
        fill(grid, ZERO)
        _store(voxels.coordinates, voxels.packed, np.uint64(voxels.side), grid)
        return DenseVoxels(voxels.side, grid)

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        return {"grid": self.grid}

    def query(self, points: np.ndarray, packed: np.ndarray, occupied: np.ndarray) -> None:
        """Packed values (M,) uint64 and occupied (M,) bool at points (M, 3) float32, voxel coordinates; not occupied outside of the grid."""
        _query(points, np.uint64(self.side), self.grid, packed, occupied)
