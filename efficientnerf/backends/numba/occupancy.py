"""The density voxels (EfficientNeRF, section 3.2) on the CPU (numba, all cores): their update, random cells, and points in cells.

The reference is `efficientnerf.backends.torch.occupancy`. Random numbers are a hash of a seed and an index (Steele, Lea and Flood 2014, "Fast splittable
pseudorandom number generators"): each core draws its own, and any number of cores the same.
"""

import numpy as np

from efficientnerf.backends.numba.compositing import activate_density
from efficientnerf.backends.numba.runtime import PRANGE, numba

BLOCK = 1024  # samples per task
SCAN = 2**15  # voxels per task
RANDOM_BITS = 21  # of a coordinate in its cell


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def cells_of_points(point, side, cell):
    """`efficientnerf.sampling.occupancy.cell_of` of points (N, 3) into cell (N,) int32."""
    for block in numba.prange((len(cell) + BLOCK - 1) // BLOCK):
        for n in range(block * BLOCK, min(len(cell), (block + 1) * BLOCK)):
            i = min(max(int(point[n, 0] * side), 0), side - 1)
            j = min(max(int(point[n, 1] * side), 0), side - 1)
            k = min(max(int(point[n, 2] * side), 0), side - 1)
            cell[n] = (i * side + j) * side + k


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def update_occupancy_maximum(cell, raw, exponential, flat, parts):
    """Raise voxels `flat` (D^3,) to the density of samples in cells (N,) int32, `raw` (N,) activated; masked voxels (-inf) stay masked.

    parts  of the voxels, one for each thread, which looks at all samples: no two threads write to one voxel
    """
    density = np.empty(len(cell), np.float32)
    for block in numba.prange((len(cell) + BLOCK - 1) // BLOCK):
        for n in range(block * BLOCK, min(len(cell), (block + 1) * BLOCK)):
            density[n] = activate_density(raw[n], exponential)[0]
    for part in numba.prange(parts):
        begin, end = part * len(flat) // parts, (part + 1) * len(flat) // parts
        for n in range(len(cell)):
            at = cell[n]
            if begin <= at < end and density[n] > flat[at] and flat[at] != -np.inf:
                flat[at] = density[n]


@numba.njit(cache=True, inline="always", error_model="numpy")
def _random(seed, n):
    """The n-th number of 64 bits of a seed, both uint64."""
    z = seed + (n + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def points_in_cells(cell, side, seed, point):
    """A random point (N, 3), grid coordinates, in each of the cells (N,) int32; seed uint64."""
    mask, unit = np.uint64(2**RANDOM_BITS - 1), np.float32(2.0**-RANDOM_BITS)
    size = np.float32(side)
    for block in numba.prange((len(cell) + BLOCK - 1) // BLOCK):
        for n in range(block * BLOCK, min(len(cell), (block + 1) * BLOCK)):
            bits, c = _random(seed, np.uint64(n)), cell[n]
            point[n, 0] = (np.float32(c // (side * side)) + np.float32(bits & mask) * unit) / size
            point[n, 1] = (np.float32(c // side % side) + np.float32((bits >> np.uint64(RANDOM_BITS)) & mask) * unit) / size
            point[n, 2] = (np.float32(c % side) + np.float32((bits >> np.uint64(2 * RANDOM_BITS)) & mask) * unit) / size


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def random_cells(flat, threshold, seed, half, cell):
    """`efficientnerf.sampling.occupancy.random_cells`: the first `half` of cell (N,) int32 among all voxels `flat` (D^3,), the others among the valid.

    Returns how many are drawn: N, or `half` where none is valid.
    """
    blocks = (len(flat) + SCAN - 1) // SCAN
    first = np.zeros(blocks + 1, np.int64)
    for block in numba.prange(blocks):
        found = 0
        for n in range(block * SCAN, min(len(flat), (block + 1) * SCAN)):
            found += flat[n] > threshold
        first[block + 1] = found
    for block in range(blocks):
        first[block + 1] += first[block]
    count = first[blocks]
    valid = np.empty(count, np.int32)
    for block in numba.prange(blocks):
        at = first[block]
        for n in range(block * SCAN, min(len(flat), (block + 1) * SCAN)):
            if flat[n] > threshold:
                valid[at] = n
                at += 1
    drawn = len(cell) if count > 0 else half
    for n in numba.prange(drawn):
        among = n >= half
        place, parts = (n - half, len(cell) - half) if among else (n, half)
        chance = (place + np.float64(_random(seed, np.uint64(n)) >> np.uint64(11)) * 2.0**-53) / parts
        size = count if among else len(flat)
        index = min(np.int64(chance * size), size - 1)
        cell[n] = valid[index] if among else index
    return drawn
