"""Rows of voxels along z (numba): where the eight voxels around a point of a packed tree lie.

A packed tree's voxels are ordered column of bricks by column, within it row by row, and along z: what a row of any brick stores, with one voxel of the bricks
before and behind it, is contiguous. Each brick has a table of its rows and of those beside it, (b + 2)^2: the first voxel of a row, and which of its b + 2 are
stored. So two neighbours along z are found by a mask and a count of bits, and read together, whatever bricks they lie in. Both are in one int32, the mask in
its lowest b + 2 bits, where the voxels are not too many for that.

B bricks, N stored voxels; b = brick.
"""

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.vector.maths import popcount

MOST_SIDE = 32  # voxels of a row whose mask is an int32


@numba.njit(cache=True, error_model="numpy")
def order_voxels(first, end, first_voxel, brick, brick_index, voxel_index, begin, stored, voxel_of, coordinates):
    """Orders the voxels of a cascade's columns of cells first <= n < end, from first_voxel on; returns the voxel after them.

    begin        (B, b^2) int32: the first voxel of each row of a brick
    stored       (B, b^2) int32: which voxels of it are stored, a bit each
    voxel_of     (N,) int32: which of the tree's voxels each one is
    coordinates  (3, N): where it lies
    """
    at, owners, heights = first_voxel, np.empty(brick_index.shape[2], np.int64), np.empty(brick_index.shape[2], np.int64)
    for column in range(first, end):
        a, e, count = column // brick_index.shape[1], column % brick_index.shape[1], 0
        for c, owner in enumerate(brick_index[a, e]):
            owners[count], heights[count] = owner, c * brick
            count += owner >= 0
        for row in range(brick * brick if count > 0 else 0):
            for n in range(count):
                owner, mask = owners[n], 0
                begin[owner, row] = at
                for k in range(brick):
                    voxel = voxel_index[owner, row * brick + k]
                    if voxel >= 0:
                        voxel_of[at] = voxel
                        coordinates[0, at], coordinates[1, at], coordinates[2, at] = a * brick + row // brick, e * brick + row % brick, heights[n] + k
                        at += 1
                        mask |= 1 << k
                stored[owner, row] = mask
    return at


@numba.njit(cache=True, inline="always", error_model="numpy")
def _owner(a, e, c, brick_index):
    """The brick of a cell, or -1."""
    inside = 0 <= a < brick_index.shape[0] and 0 <= e < brick_index.shape[1] and 0 <= c < brick_index.shape[2]
    return np.int64(brick_index[a, e, c]) if inside else np.int64(-1)


@numba.njit(cache=True, error_model="numpy")
def _row(before, here, after, row, last, begin, stored):
    """First voxel and mask of a row that crosses three bricks, any of which may be -1: the last voxel of one, all of the next, the first of the third."""
    edge = before >= 0 and stored[before, row] >> last & 1 != 0
    ahead = after >= 0 and stored[after, row] & 1 != 0
    own = np.int64(stored[here, row]) if here >= 0 else 0
    mask = np.int64(edge) | own << 1 | np.int64(ahead) << last + 2
    if edge:
        return begin[before, row] + popcount(np.int64(stored[before, row])) - 1, mask
    if own:
        return np.int64(begin[here, row]), mask
    return np.int64(begin[after, row] if ahead else 0), mask


@numba.njit(cache=True, error_model="numpy")
def fill_rows(first, end, cells, brick, brick_index, begin, stored, rows):
    """Tables of bricks first <= B < end of a cascade, into `rows`, see `Packed`."""
    side = brick + 2
    narrow = rows.shape[1] == side * side
    for owner in range(first, end):
        for p in range(3):
            for q in range(3):
                a, e, c = cells[owner, 0] + p - 1, cells[owner, 1] + q - 1, cells[owner, 2]
                before, here, after = _owner(a, e, c - 1, brick_index), _owner(a, e, c, brick_index), _owner(a, e, c + 1, brick_index)
                i0, i1 = (0, 1) if p == 0 else (1, side - 1) if p == 1 else (side - 1, side)
                j0, j1 = (0, 1) if q == 0 else (1, side - 1) if q == 1 else (side - 1, side)
                for i in range(i0, i1):
                    for j in range(j0, j1):
                        row = (i - 1 - (p - 1) * brick) * brick + j - 1 - (q - 1) * brick
                        voxel, mask = _row(before, here, after, row, brick - 1, begin, stored)
                        at = i * side + j
                        if narrow:
                            rows[owner, at] = np.int32(voxel << side | mask)
                        else:
                            rows[owner, 2 * at], rows[owner, 2 * at + 1] = voxel, mask
