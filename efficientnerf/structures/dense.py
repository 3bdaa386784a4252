"""Dense voxels: one word for each voxel of the grid, x slowest; zero where it is empty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.structures.voxels import Voxels
from efficientnerf.structures.words import CHUNK, TASK, ZERO, fill, whole, within


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _store(coordinates, words, side, grid):  # type: ignore[no-untyped-def]
    n = len(words)
    for task in numba.prange((n + TASK - 1) // TASK):
        for i in range(task * TASK, min(n, (task + 1) * TASK)):
            grid[(whole(coordinates[i, 0]) * side + whole(coordinates[i, 1])) * side + whole(coordinates[i, 2])] = words[i]


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _look_up(points, side, grid, words, found):  # type: ignore[no-untyped-def]
    n, top, outside = len(points), np.float32(side), np.uint64(len(grid) - 1)
    for task in numba.prange((n + TASK - 1) // TASK):
        where = np.empty(CHUNK, np.uint64)
        for begin in range(task * TASK, min(n, (task + 1) * TASK), CHUNK):
            end = min(begin + CHUNK, n)
            point, word, there = points[begin:end], words[begin:end], found[begin:end]
            many = np.uint64(end - begin)
            for i in range(many):
                x, y, z = point[i, 0], point[i, 1], point[i, 2]
                where[i] = (whole(x) * side + whole(y)) * side + whole(z) if within(x, y, z, top) else outside
            for i in range(many):
                word[i] = grid[where[i]]
                there[i] = word[i] != ZERO


@dataclass(frozen=True, eq=False)
class DenseVoxels:
    """side voxels along each side; grid (side^3 + 1,) uint64, the last of them zero: what lies outside."""

    side: int
    grid: np.ndarray

    @staticmethod
    def cache(voxels: Voxels) -> DenseVoxels:
        grid = np.empty(voxels.side**3 + 1, np.uint64)
        fill(grid, ZERO)
        _store(voxels.coordinates, voxels.words, np.uint64(voxels.side), grid)
        return DenseVoxels(voxels.side, grid)

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        return {"grid": self.grid}

    def query(self, points: np.ndarray, words: np.ndarray, found: np.ndarray) -> None:
        """Writes words (M,) uint64 and found (M,) bool at points (M, 3) float32, in voxels; outside of the grid nothing is found."""
        _look_up(points, np.uint64(self.side), self.grid, words, found)
