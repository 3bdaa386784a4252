"""The occupied voxels of a cubic grid: input of every structure.

Voxel (i, j, k) is the cube [i, i + 1) x [j, j + 1) x [k, k + 1). Its four values (r, g, b, density) are half precision and packed into a uint64, so that a
query copies bits. Zero stands for an empty voxel in the structures that have a slot for every voxel, as in PlenOctree, whose empty leaves have density 0; hence
no voxel may hold it.

N voxels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Voxels:
    """A list of occupied voxels.

    side         voxels along each side of the grid
    coordinates  (N, 3) int32, each once, in any order
    packed       (N,) uint64 values, none zero
    """

    side: int
    coordinates: np.ndarray
    packed: np.ndarray

    @property
    def values(self) -> np.ndarray:
        """(N, 4) float16."""
        return unpack_values(self.packed)


def pack_values(values: np.ndarray) -> np.ndarray:
    """Values (N, 4) float16 as (N,) uint64; a view where they are contiguous."""
    return np.ascontiguousarray(values, np.float16).view(np.uint64)[:, 0]


def unpack_values(packed: np.ndarray) -> np.ndarray:
    """The inverse of `pack_values`."""
    return packed[:, None].view(np.float16)


def voxels_from_values(side: int, coordinates: np.ndarray, values: np.ndarray) -> Voxels:
    """Checked and packed voxels: coordinates (N, 3) integers in [0, side), values (N, 4) float16.

    Raises ValueError for voxels outside of the grid, listed twice, or whose four values are all zero.
    """
    coordinates = np.ascontiguousarray(coordinates, np.int32)
    if coordinates.ndim != 2 or coordinates.shape[1] != 3 or values.shape != (len(coordinates), 4):
        raise ValueError(f"voxels: coordinates {coordinates.shape} and values {values.shape}; expected (N, 3) and (N, 4)")
    if len(coordinates) and (coordinates.min() < 0 or coordinates.max() >= side):
        raise ValueError(f"voxels: coordinates from {coordinates.min()} to {coordinates.max()}; expected 0 to {side - 1}")
    packed = pack_values(values)
    if not packed.all():
        raise ValueError(f"voxels: {int((packed == 0).sum())} hold four zeros, which stand for an empty voxel; leave them out")
    occupied = np.zeros((side, side, side), bool)
    occupied[tuple(coordinates.T)] = True
    if (distinct := int(np.count_nonzero(occupied))) != len(coordinates):
        raise ValueError(f"voxels: {len(coordinates) - distinct} are listed twice; expected each once")
    return Voxels(side, coordinates, packed)
