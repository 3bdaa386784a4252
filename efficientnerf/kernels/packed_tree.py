"""A tree laid out for the marching kernel, made once from whatever the tree keeps in memory.

Marching reads densities far more often than anything else, at points whose eight voxels lie in up to eight bricks. So every brick gets a block
of its own voxels and of the one layer around them, (b + 2)^3 values side by side: no lookup leaves the block. A second block says where the
harmonics of the same voxels lie. Harmonics are 16-bit whole numbers with a scale to each voxel: one cache line to a voxel at degree 2.

Places where nothing is stored have density 0 and the index N, whose harmonics are a row of zeros. Where all eight voxels of an interpolation are zero the
density at its low corner is -0.0, which adds up as zero does and says that the other seven need not be read.

B bricks, N stored voxels, K harmonics; b = brick.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numba
import numpy as np

if TYPE_CHECKING:
    from efficientnerf.nerftree.tree import NerfTree

LANES = 16  # coefficients are padded to multiples of it: what the widest vectors hold
LEVELS = 32767
DECODED = 2**18  # voxels whose harmonics are floats at a time


class Packed(NamedTuple):
    """See the module.

    cell     (X, Y, Z) int32: the brick of a coarse cell, or -1 - leap where it is empty
    density  (B, (b + 2)^3) float32, per world unit; local voxel (i, j, k) is voxel (i - 1, j - 1, k - 1) of the brick
    voxel    (B, (b + 2)^3) int32: which row of sh, N where nothing is stored
    sh       (N + 1, P) int16: coefficient k of channel c at 3 k + c, padded with zeros
    scale    (N + 1,) float32: coefficient = sh * scale
    """

    cell: np.ndarray
    density: np.ndarray
    voxel: np.ndarray
    sh: np.ndarray
    scale: np.ndarray

    @property
    def nbytes(self) -> int:
        return sum(part.nbytes for part in self)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _fill(cells, brick, brick_index, voxel_index, values, density, voxel):  # type: ignore[no-untyped-def]
    """Blocks of the bricks; cells (B, 3) says where each brick lies."""
    side, none = brick + 2, len(values)
    for owner in numba.prange(len(cells)):
        for i in range(side):
            for j in range(side):
                for k in range(side):
                    u, v, w = cells[owner, 0] * brick + i - 1, cells[owner, 1] * brick + j - 1, cells[owner, 2] * brick + k - 1
                    index = none
                    if u >= 0 and v >= 0 and w >= 0:
                        a, e, c = u // brick, v // brick, w // brick
                        if a < brick_index.shape[0] and e < brick_index.shape[1] and c < brick_index.shape[2] and brick_index[a, e, c] >= 0:
                            stored = voxel_index[brick_index[a, e, c], ((u - a * brick) * brick + (v - e * brick)) * brick + (w - c * brick)]
                            index = stored if stored >= 0 else none
                    at = (i * side + j) * side + k
                    voxel[owner, at] = index
                    density[owner, at] = values[index] if index < none else np.float32(0)
        for i in range(side - 1):
            for j in range(side - 1):
                for k in range(side - 1):
                    at = (i * side + j) * side + k
                    idle = True
                    for n in range(8):
                        if density[owner, at + (n >> 2) * side * side + ((n >> 1) & 1) * side + (n & 1)] > 0:
                            idle = False
                    if idle:
                        density[owner, at] = np.float32(-0.0)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _quantise(values, sh, scale):  # type: ignore[no-untyped-def]
    """Rows of (n, K, 3) float32 to whole numbers and their scales."""
    for n in numba.prange(len(values)):
        most = np.float32(0)
        for k in range(values.shape[1]):
            for c in range(3):
                most = max(most, abs(values[n, k, c]))
        scale[n] = most / np.float32(LEVELS)
        if most > 0:
            for k in range(values.shape[1]):
                for c in range(3):
                    sh[n, 3 * k + c] = np.int16(np.rint(values[n, k, c] / most * np.float32(LEVELS)))


def pack(tree: NerfTree) -> Packed:
    brick, count = tree.brick, len(tree.density_values)
    cells = np.argwhere(tree.brick_index >= 0)
    owners = tree.brick_index[tree.brick_index >= 0]
    place = np.empty_like(cells)
    place[owners] = cells
    cell = np.where(tree.brick_index >= 0, tree.brick_index, -1 - tree.leap.astype(np.int32))
    density = np.empty((len(cells), (brick + 2) ** 3), np.float32)
    voxel = np.empty(density.shape, np.int32)
    _fill(place, brick, tree.brick_index, tree.voxel_index, tree.density_values, density, voxel)
    width = -(-3 * tree.harmonics_count // LANES) * LANES
    sh, scale = np.zeros((count + 1, width), np.int16), np.zeros(count + 1, np.float32)
    for begin in range(0, count, DECODED):  # floats of all voxels at once may be more than all the rest
        block = slice(begin, min(count, begin + DECODED))
        _quantise(tree.coefficients(block), sh[block], scale[block])
    return Packed(np.ascontiguousarray(cell, np.int32), density, voxel, sh, scale)
