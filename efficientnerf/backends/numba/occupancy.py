"""Update of the density voxels (EfficientNeRF, section 3.2) on the CPU (numba, all cores). The reference is `efficientnerf.sampling.occupancy.update`."""

from __future__ import annotations

import numpy as np

from efficientnerf.backends.numba.compositing import activate_density
from efficientnerf.backends.numba.runtime import numba

BLOCK = 1024  # samples per task


@numba.njit(cache=True, parallel=True, error_model="numpy")
def update_occupancy(point, raw, exponential, values):  # type: ignore[no-untyped-def]
    """Raise `values` (D, D, D) to the density of samples at `point` (N, 3) in grid coordinates, `raw` (N,) activated; masked cells (-inf) stay masked.

    All cores compute voxels and densities, then one takes the maxima.
    """
    side, count = values.shape[0], len(raw)
    cell, density = np.empty(count, np.int32), np.empty(count, np.float32)
    for block in numba.prange((count + BLOCK - 1) // BLOCK):
        for n in range(block * BLOCK, min(count, (block + 1) * BLOCK)):
            i = min(max(int(point[n, 0] * side), 0), side - 1)
            j = min(max(int(point[n, 1] * side), 0), side - 1)
            k = min(max(int(point[n, 2] * side), 0), side - 1)
            cell[n], density[n] = (i * side + j) * side + k, activate_density(raw[n], exponential)[0]
    flat = values.reshape(-1)
    for n in range(count):
        old = flat[cell[n]]
        if density[n] > old and old != -np.inf:
            flat[cell[n]] = density[n]
