"""Which rays come near occupied coarse cells of a tree of one grid (numba). R rays."""

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.tree.march import box_distances


@numba.njit(cache=True, error_model="numpy")
def _comes_near(ox, oy, oz, dx, dy, dz, leap):
    """Whether a ray, coordinates in coarse cells, meets a cell whose leap is 0."""
    nx, ny, nz = leap.shape
    t, end = box_distances(ox, oy, oz, dx, dy, dz, nx, ny, nz)
    while t < end:
        # Half a thousandth beyond a face, so that rounding never leaves the ray where it was.
        at = t + 5e-4
        x, y, z = min(max(int(ox + at * dx), 0), nx - 1), min(max(int(oy + at * dy), 0), ny - 1), min(max(int(oz + at * dz), 0), nz - 1)
        far = np.int64(leap[x, y, z])
        if far == 0:
            return True
        leave = 1e30
        if dx != 0:
            leave = min(leave, ((x + far if dx > 0 else x - far + 1) - ox) / dx)
        if dy != 0:
            leave = min(leave, ((y + far if dy > 0 else y - far + 1) - oy) / dy)
        if dz != 0:
            leave = min(leave, ((z + far if dz > 0 else z - far + 1) - oz) / dz)
        t = max(leave, at)
    return False


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def come_near(origins, directions, leap, found):
    """Whether rays (R, 3), unit directions and origins in coarse cells, meet a cell whose leap is 0, into `found` (R,) bool."""
    for n in numba.prange(len(origins)):
        found[n] = _comes_near(origins[n, 0], origins[n, 1], origins[n, 2], directions[n, 0], directions[n, 1], directions[n, 2], leap)
