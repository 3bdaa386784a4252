"""The occupied voxels of a cubic grid, as they are handed to every structure.

Voxel (i, j, k) is the cube [i, i + 1) x [j, j + 1) x [k, k + 1). Its four values (r, g, b, density) are half precision and travel as one
64-bit word: looking up copies bits. A word of zeros means "nothing here" in the structures that have a place for every voxel (so it does
in PlenOctree, whose empty leaves have density 0), hence no voxel may hold it.

N voxels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Voxels:
    """What is to be cached.

    side         voxels along each side of the grid
    coordinates  (N, 3) int32, each once, in any order
    words        (N,) uint64, none zero
    """

    side: int
    coordinates: np.ndarray
    words: np.ndarray

    @property
    def values(self) -> np.ndarray:
        """(N, 4) float16."""
        return values_from_words(self.words)


def words_from_values(values: np.ndarray) -> np.ndarray:
    """Values (N, 4) float16 as words (N,) uint64; a view where they are contiguous."""
    return np.ascontiguousarray(values, np.float16).view(np.uint64)[:, 0]


def values_from_words(words: np.ndarray) -> np.ndarray:
    """The inverse of `words_from_values`."""
    return words[:, None].view(np.float16)


def voxels_from_values(side: int, coordinates: np.ndarray, values: np.ndarray) -> Voxels:
    """Check and pack a list of voxels: coordinates (N, 3) integers in [0, side), values (N, 4) float16.

    Raises ValueError for voxels outside of the grid, listed twice, or whose four values are all zero.
    """
    coordinates = np.ascontiguousarray(coordinates, np.int32)
    if coordinates.ndim != 2 or coordinates.shape[1] != 3 or values.shape != (len(coordinates), 4):
        raise ValueError(f"voxels: coordinates {coordinates.shape} and values {values.shape}; expected (N, 3) and (N, 4)")
    if len(coordinates) and (coordinates.min() < 0 or coordinates.max() >= side):
        raise ValueError(f"voxels: coordinates from {coordinates.min()} to {coordinates.max()}; expected 0 to {side - 1}")
    words = words_from_values(values)
    if not words.all():
        raise ValueError(f"voxels: {int((words == 0).sum())} hold four zeros, which stand for an empty voxel; leave them out")
    seen = np.zeros((side, side, side), bool)
    seen[tuple(coordinates.T)] = True
    if (distinct := int(np.count_nonzero(seen))) != len(coordinates):
        raise ValueError(f"voxels: {len(coordinates) - distinct} are listed twice; expected each once")
    return Voxels(side, coordinates, words)
