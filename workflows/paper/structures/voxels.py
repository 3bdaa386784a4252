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
