"""Spherical harmonics of the directions of rays, on the CPU (numba, all cores).

The reference is `efficientnerf.rendering.harmonics.basis`; here each direction is read once. Products are taken in its order, so that both give the same bytes.
R rays, K harmonics.
"""

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.rendering import harmonics

BLOCK = 512  # rays per task
_FACTORS = np.array([harmonics.C0, -harmonics.C1, harmonics.C1, -harmonics.C1, *harmonics.C2, *harmonics.C3, *harmonics.C4], np.float32)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def basis(directions, degree, out):  # type: ignore[no-untyped-def]
    """Harmonics up to `degree` of unit directions (R, 3) into out (R, K)."""
    one, two, three, four, seven = np.float32(1), np.float32(2), np.float32(3), np.float32(4), np.float32(7)
    c = _FACTORS
    for block in numba.prange((len(directions) + BLOCK - 1) // BLOCK):
        for r in range(block * BLOCK, min(len(directions), (block + 1) * BLOCK)):
            x, y, z = directions[r, 0], directions[r, 1], directions[r, 2]
            xx, yy, zz = x * x, y * y, z * z
            out[r, 0] = c[0]
            if degree > 0:
                out[r, 1], out[r, 2], out[r, 3] = c[1] * y, c[2] * z, c[3] * x
            if degree > 1:
                out[r, 4], out[r, 5], out[r, 6] = c[4] * x * y, c[5] * y * z, c[6] * (two * zz - xx - yy)
                out[r, 7], out[r, 8] = c[7] * x * z, c[8] * (xx - yy)
            if degree > 2:
                out[r, 9], out[r, 10], out[r, 11] = c[9] * y * (three * xx - yy), c[10] * x * y * z, c[11] * y * (four * zz - xx - yy)
                out[r, 12], out[r, 13] = c[12] * z * (two * zz - three * xx - three * yy), c[13] * x * (four * zz - xx - yy)
                out[r, 14], out[r, 15] = c[14] * z * (xx - yy), c[15] * x * (xx - three * yy)
            if degree > 3:
                out[r, 16], out[r, 17] = c[16] * x * y * (xx - yy), c[17] * y * z * (three * xx - yy)
                out[r, 18], out[r, 19] = c[18] * x * y * (seven * zz - one), c[19] * y * z * (seven * zz - three)
                out[r, 20] = c[20] * (zz * (np.float32(35) * zz - np.float32(30)) + three)
                out[r, 21], out[r, 22] = c[21] * x * z * (seven * zz - three), c[22] * (xx - yy) * (seven * zz - one)
                out[r, 23], out[r, 24] = c[23] * x * z * (xx - three * yy), c[24] * (xx * (xx - three * yy) - yy * (three * xx - yy))
