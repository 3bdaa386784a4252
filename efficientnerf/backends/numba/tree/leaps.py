"""Distances of coarse cells to the nearest occupied one (numba): `NerfTree.leap`, in as many bytes as there are cells, and the same in eight directions."""

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba

CELLS_PER_CALL = 2**25


@numba.njit(cache=True, inline="always", error_model="numpy")
def _nearer(out, x, y, z, found):
    """The least of `found` and the values of three cells along z around (x, y, z)."""
    found = min(found, out[x, y, z])
    if z > 0:
        found = min(found, out[x, y, z - 1])
    if z + 1 < out.shape[2]:
        found = min(found, out[x, y, z + 1])
    return found


@numba.njit(cache=True, error_model="numpy")
def _sweep(out, begin, end, step):
    """Lower the cells of layers begin, begin + step, ... to one more than the least of their neighbours that come before them in this direction."""
    nx, ny, nz = out.shape
    most = np.uint8(255)
    y0, z0 = (0, 0) if step > 0 else (ny - 1, nz - 1)
    for x in range(begin, end, step):
        for row in range(ny):
            y = y0 + step * row
            for column in range(nz):
                z = z0 + step * column
                if out[x, y, z] == 0:
                    continue
                found = most
                if 0 <= x - step < nx:
                    found = _nearer(out, x - step, y, z, found)
                    if y > 0:
                        found = _nearer(out, x - step, y - 1, z, found)
                    if y + 1 < ny:
                        found = _nearer(out, x - step, y + 1, z, found)
                if row > 0:
                    found = _nearer(out, x, y - step, z, found)
                if column > 0:
                    found = min(found, out[x, y, z - step])
                if found < out[x, y, z]:
                    out[x, y, z] = found + np.uint8(1)


def leaps(occupied: np.ndarray) -> np.ndarray:
    """Chessboard distance of cells (X, Y, Z) bool to the nearest occupied one, at most 255: uint8.

    Two sweeps over the 26 neighbours (Rosenfeld & Pfaltz 1968).
    """
    out = np.where(occupied, np.uint8(0), np.uint8(255))
    layers = max(1, CELLS_PER_CALL // max(1, out[0].size))
    for begin in range(0, len(out), layers):
        _sweep(out, begin, min(len(out), begin + layers), 1)
    for begin in range(len(out) - 1, -1, -layers):
        _sweep(out, begin, max(-1, begin - layers), -1)
    return out


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _sweep_octants(occupied, out):
    nx, ny, nz = occupied.shape
    for octant in numba.prange(8):
        sx, sy, sz = 1 if octant & 1 else -1, 1 if octant & 2 else -1, 1 if octant & 4 else -1
        for p in range(nx):
            x = nx - 1 - p if sx > 0 else p
            for q in range(ny):
                y = ny - 1 - q if sy > 0 else q
                # Least of the three lines beside this one, at the cell before; and of the cell before.
                beside, before = 255, 255
                for r in range(nz):
                    z = nz - 1 - r if sz > 0 else r
                    least = 255
                    if p > 0 and out[octant, x + sx, y, z] < least:
                        least = out[octant, x + sx, y, z]
                    if q > 0 and out[octant, x, y + sy, z] < least:
                        least = out[octant, x, y + sy, z]
                    if p > 0 and q > 0 and out[octant, x + sx, y + sy, z] < least:
                        least = out[octant, x + sx, y + sy, z]
                    before = 0 if occupied[x, y, z] else min(min(before, min(least, beside)) + 1, 255)
                    out[octant, x, y, z], beside = before, least


def octant_leaps(occupied: np.ndarray) -> np.ndarray:
    """Sides, in cells, of the largest cubes without an occupied cell of (X, Y, Z) bool that extend from each cell in each of eight directions: (8, X, Y, Z)
    uint8, at most 255, 0 for an occupied cell.

    Of direction n the cube extends to greater x where n & 1 is set, else to less; n & 2 is of y, and n & 4 of z. What is outside of the grid is empty. A ray
    that leaves a surface behind it crosses what is empty ahead in one leap: docs/experiments/renderer.md
    """
    out = np.empty((8, *occupied.shape), np.uint8)
    _sweep_octants(np.ascontiguousarray(occupied), out)
    return out
