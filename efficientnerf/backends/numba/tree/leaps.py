"""Distances of coarse cells to the nearest occupied one (numba): `NerfTree.leap`, in as many bytes as there are cells."""

from __future__ import annotations

import numpy as np

from efficientnerf.backends.numba.runtime import numba

CELLS_PER_CALL = 2**25


@numba.njit(cache=True, inline="always", error_model="numpy")
def _nearer(out, x, y, z, found):  # type: ignore[no-untyped-def]
    """The least of `found` and the values of three cells along z around (x, y, z)."""
    found = min(found, out[x, y, z])
    if z > 0:
        found = min(found, out[x, y, z - 1])
    if z + 1 < out.shape[2]:
        found = min(found, out[x, y, z + 1])
    return found


@numba.njit(cache=True, error_model="numpy")
def _sweep(out, begin, end, step):  # type: ignore[no-untyped-def]
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
