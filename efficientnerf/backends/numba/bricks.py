"""Sets of voxels on the CPU (numba): selection and dilation by weight, and weights resampled to a coarser grid.

B coarse cells with a row of brick^3 voxels each, N voxels.
"""

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba

RAYS = 256  # per task
MARGIN = 0.5  # voxels; the box is enlarged and the hole shrunk by so much, to skip samples surely outside or hidden; the others are tested one by one
MAX_PIECES = 64  # of a sample that reaches through many voxels


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def threshold_and_dilate(cells, greatest, threshold, shape, brick, dilate, row_of, into):
    """Set `into` for each voxel whose weight exceeds `threshold`, and for those up to `dilate` voxels away along each axis, inside the grid.

    cells     flat indices (x slowest) of the coarse cells that the rows of `greatest` (., brick^3) belong to
    row_of    (coarse cells,) int32: row of `into` (B, brick^3) bool, or -1; every cell that is reached must have one

    Threads may set the same voxel.
    """
    for row in numba.prange(len(cells)):
        cell = cells[row]
        a, b, c = cell // (shape[1] * shape[2]), cell // shape[2] % shape[1], cell % shape[2]
        for local in range(brick**3):
            if not greatest[row, local] > threshold:
                continue
            i, j, k = a * brick + local // (brick * brick), b * brick + local // brick % brick, c * brick + local % brick
            for x in range(max(0, i - dilate), min(shape[0] * brick, i + dilate + 1)):
                for y in range(max(0, j - dilate), min(shape[1] * brick, j + dilate + 1)):
                    for z in range(max(0, k - dilate), min(shape[2] * brick, k + dilate + 1)):
                        owner = row_of[(x // brick * shape[1] + y // brick) * shape[2] + z // brick]
                        into[owner, (x % brick * brick + y % brick) * brick + z % brick] = True


@numba.njit(cache=True, error_model="numpy")
def flat_indices(into, cells, shape, brick, flat):
    """Flat indices in the grid (x slowest) of the voxels set in `into` (B, brick^3) bool, whose rows belong to `cells`, to `flat` (N,)."""
    n = 0
    for row in range(len(cells)):
        cell = cells[row]
        a, b, c = cell // (shape[1] * shape[2]), cell // shape[2] % shape[1], cell % shape[2]
        for local in range(brick**3):
            if into[row, local]:
                i, j, k = a * brick + local // (brick * brick), b * brick + local // brick % brick, c * brick + local % brick
                flat[n] = (i * shape[1] * brick + j) * shape[2] * brick + k
                n += 1


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def coordinates_of(flat, rows, columns, index):
    """Coordinates (N, 3) int32 of flat indices (N,) in a grid (., rows, columns)."""
    for n in numba.prange(len(flat)):
        rest, column = divmod(flat[n], columns)
        index[n, 0], index[n, 1], index[n, 2] = rest // rows, rest % rows, column


@numba.njit(cache=True, inline="always", error_model="numpy")
def _raise_voxel(x, y, z, weight, shape, brick, row_of, into, rows):
    """Raise voxel (x, y, z) to a weight, in the row of its cell, which gets one if it has none and there is room; returns the number of rows in use."""
    owner = (x // brick * shape[1] + y // brick) * shape[2] + z // brick
    if row_of[owner] < 0:
        row_of[owner] = rows
        rows += 1
    to = row_of[owner]
    if to < len(into):
        at = (x % brick * brick + y % brick) * brick + z % brick
        into[to, at] = max(into[to, at], weight)
    return rows


@numba.njit(cache=True, error_model="numpy")
def resample_weights(cells, greatest, threshold, shape, to_shape, ratio, brick, row_of, into, rows):
    """Raise the voxels of a coarser grid to the weights above `threshold` of the finer voxels whose centres they hold; returns the number of rows in use.

    ratio   side of a finer voxel over that of a coarser one
    row_of  (cells of the coarser grid,) int32: row of `into`, or -1; rows are assigned as needed, from `rows` on
    into    (., brick^3) float32, zeros; where it has too few rows, only `row_of` and the count are updated
    """
    for row in range(len(cells)):
        cell = cells[row]
        a, b, c = cell // (shape[1] * shape[2]), cell // shape[2] % shape[1], cell % shape[2]
        for local in range(brick**3):
            weight = greatest[row, local]
            if not weight > threshold:
                continue
            x = min(int((a * brick + local // (brick * brick) + 0.5) * ratio), to_shape[0] * brick - 1)
            y = min(int((b * brick + local // brick % brick + 0.5) * ratio), to_shape[1] * brick - 1)
            z = min(int((c * brick + local % brick + 0.5) * ratio), to_shape[2] * brick - 1)
            rows = _raise_voxel(x, y, z, weight, to_shape, brick, row_of, into, rows)
    return rows


@numba.njit(error_model="numpy")
def _way_through(origin, direction, low, high):
    """Where a ray enters and leaves a box; leaving before entering where it misses it."""
    enters, leaves = -np.inf, np.inf
    for axis in range(3):
        if direction[axis] == 0:
            if not low[axis] <= origin[axis] <= high[axis]:
                return 0.0, -1.0
            continue
        one, other = (low[axis] - origin[axis]) / direction[axis], (high[axis] - origin[axis]) / direction[axis]
        enters, leaves = max(enters, min(one, other)), min(leaves, max(one, other))
    return enters, leaves


@numba.njit(cache=True, nogil=True, error_model="numpy")
def weigh_voxels(origin, direction, first, start, extent, weight, thickness, threshold, shape, voxel, low, hole, brick, row_of, into, rows):
    """Raise voxels to the weights above `threshold` of samples that pass through them; returns the number of rows in use.

    origin, direction, first  of rays: (R, 3), (R, 3), (R + 1,)
    start, extent, weight, thickness  of their samples, (M,): a sample is cut into pieces of about a voxel, and its weight as its optical thickness says
    hole          (2, 3) box that is left out
    row_of, into  as in `resample_weights`
    """
    size = np.array([shape[0] * brick, shape[1] * brick, shape[2] * brick])
    margin = MARGIN * voxel
    outer_low, outer_high, hole_low, hole_high = low - margin, low + size * voxel + margin, hole[0] + margin, hole[1] - margin
    for r in range(len(first) - 1):
        enters, leaves = _way_through(origin[r], direction[r], outer_low, outer_high)
        hidden, shown = _way_through(origin[r], direction[r], hole_low, hole_high)
        for n in range(first[r], first[r + 1]):
            end = np.float64(start[n]) + extent[n]
            if not weight[n] > threshold or end < enters or start[n] > leaves or (start[n] > hidden and end < shown):
                continue
            depth = np.float64(thickness[n])
            absorbed = -np.expm1(-depth)
            light = weight[n] / absorbed if absorbed > 0 else 0.0
            count = max(1, min(MAX_PIECES, int(np.ceil(extent[n] / voxel))))
            passed = 1.0
            for k in range(count):
                after = np.exp(-depth * (k + 1) / count)
                share = np.float32(light * (passed - after)) if count > 1 else weight[n]
                passed = after
                if not share > threshold:
                    continue
                t = start[n] + (k + 0.5) / count * extent[n]
                px, py, pz = origin[r, 0] + t * direction[r, 0], origin[r, 1] + t * direction[r, 1], origin[r, 2] + t * direction[r, 2]
                if hole[0, 0] <= px < hole[1, 0] and hole[0, 1] <= py < hole[1, 1] and hole[0, 2] <= pz < hole[1, 2]:
                    continue
                x, y, z = int(np.floor((px - low[0]) / voxel)), int(np.floor((py - low[1]) / voxel)), int(np.floor((pz - low[2]) / voxel))
                if x < 0 or y < 0 or z < 0 or x >= size[0] or y >= size[1] or z >= size[2]:
                    continue
                rows = _raise_voxel(x, y, z, share, shape, brick, row_of, into, rows)
    return rows


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def greatest_around(indices, greatest, shape, brick, row_of, out):
    """The greatest weight of voxels (N, 3), and that of each and the 26 around it, to the columns of `out` (N, 2).

    greatest  (B, brick^3) of the coarse cells of which `row_of` (cells,) int32 has the row, or -1
    """
    for n in numba.prange(len(indices)):
        best, own = np.float32(0), np.float32(0)
        for x in range(max(0, indices[n, 0] - 1), min(shape[0] * brick, indices[n, 0] + 2)):
            for y in range(max(0, indices[n, 1] - 1), min(shape[1] * brick, indices[n, 1] + 2)):
                for z in range(max(0, indices[n, 2] - 1), min(shape[2] * brick, indices[n, 2] + 2)):
                    row = row_of[(x // brick * shape[1] + y // brick) * shape[2] + z // brick]
                    if row >= 0:
                        weight = greatest[row, (x % brick * brick + y % brick) * brick + z % brick]
                        best = max(best, weight)
                        if x == indices[n, 0] and y == indices[n, 1] and z == indices[n, 2]:
                            own = weight
        out[n, 0], out[n, 1] = own, best


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def boxes_of_samples(origin, direction, first, start, extent, boxes, out):
    """Number of the first of the boxes (L, 2, 3) float64 that holds the middle of each sample, L where none does, to out (M,) int64; the rest as for
    `weigh_voxels`, in float32."""
    rays = len(first) - 1
    for block in numba.prange((rays + RAYS - 1) // RAYS):
        for r in range(block * RAYS, min(rays, (block + 1) * RAYS)):
            for n in range(first[r], first[r + 1]):
                t = start[n] + extent[n] / np.float32(2)
                x, y, z = origin[r, 0] + t * direction[r, 0], origin[r, 1] + t * direction[r, 1], origin[r, 2] + t * direction[r, 2]
                found = len(boxes)
                for k in range(len(boxes) - 1, -1, -1):
                    low, high = boxes[k, 0], boxes[k, 1]
                    if low[0] <= x < high[0] and low[1] <= y < high[1] and low[2] <= z < high[2]:
                        found = k
                out[n] = found
