"""Valid and pivotal samples of rays (EfficientNeRF, sections 3.3 and 3.4) on the CPU (numba, all cores).

The reference is `efficientnerf.sampling.samples`. Rays are split into fixed blocks and each ray belongs to one thread, so results depend neither on timing
nor on the number of threads.

R rays, N samples.
"""

from __future__ import annotations

import numpy as np

from efficientnerf.backends.numba import intervals
from efficientnerf.backends.numba.intervals import RAYS
from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.simd import pointer
from efficientnerf.geometry.spaces import FARTHEST

BLOCK = 64  # rays per task


@numba.njit(cache=True, error_model="numpy")
def _enter(ox, oy, oz, dx, dy, dz, near, far, centre, half, contracted, state, lane):  # type: ignore[no-untyped-def]
    """A ray into a lane of the state of `next_intervals`."""
    ux, uy, uz = (ox - centre[0]) / half[0], (oy - centre[1]) / half[1], (oz - centre[2]) / half[2]
    vx, vy, vz = dx / half[0], dy / half[1], dz / half[2]
    tiny = np.float32(1e-12)
    one = np.float32(1)
    t, leave = near, far
    if not contracted:
        sx = vx if abs(vx) >= tiny else tiny
        sy = vy if abs(vy) >= tiny else tiny
        sz = vz if abs(vz) >= tiny else tiny
        ax, bx = (-one - ux) / sx, (one - ux) / sx
        ay, by = (-one - uy) / sy, (one - uy) / sy
        az, bz = (-one - uz) / sz, (one - uz) / sz
        t = max(max(min(ax, bx), min(ay, by)), max(min(az, bz), near))
        leave = min(min(max(ax, bx), max(ay, by)), min(max(az, bz), far))
    state[intervals.UX, lane], state[intervals.UY, lane], state[intervals.UZ, lane] = ux, uy, uz
    state[intervals.VX, lane], state[intervals.VY, lane], state[intervals.VZ, lane] = vx, vy, vz
    state[intervals.T, lane], state[intervals.LEAVE, lane] = t, leave


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _find_valid(  # type: ignore[no-untyped-def]
    origins, directions, near, far, offset, centre, half, contracted, step, slots, voxels, threshold, whole, counts, tried, leave, begins
):
    """Sixteen rays side by side, a lane each, until the last of them is at its end."""
    least, never, side, grid = np.float32(FARTHEST), np.float32(-np.inf), voxels.shape[0], pointer(voxels)
    for block in numba.prange((len(origins) + RAYS - 1) // RAYS):
        begin, end = block * RAYS, min(len(origins), (block + 1) * RAYS)
        state = np.zeros((intervals.ROWS, RAYS), np.float32)  # lanes without a ray are at their end
        for r in range(begin, end):
            _enter(
                origins[r, 0], origins[r, 1], origins[r, 2], directions[r, 0], directions[r, 1], directions[r, 2], near[r], far[r],
                centre, half, contracted, state, r - begin,
            )  # fmt: skip
            state[intervals.OFFSET, r - begin], state[intervals.LIMIT, r - begin] = offset[r], never if r < whole else threshold
        lanes = pointer(state)
        for _ in range(slots):
            if contracted:
                found = intervals.next_intervals_contracted(lanes, grid, side, step, least)
            else:
                found = intervals.next_intervals_in_box(lanes, grid, side, step, least)
            if found == 0:
                break
            found >>= RAYS
            while found != 0:
                lane = intervals.lowest_bit(found)
                found &= found - 1
                r = begin + lane
                begins[r, counts[r]] = state[intervals.BEGAN, lane]
                counts[r] += 1
        for r in range(begin, end):
            tried[r], leave[r] = np.int64(state[intervals.TRIED, r - begin]), state[intervals.LEAVE, r - begin]


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _write_valid(origins, directions, offset, centre, half, contracted, step, leave, begins, first, start, extent, length, point):  # type: ignore[no-untyped-def]
    one, two = np.float32(1), np.float32(2)
    scale = np.float32(0.25) if contracted else np.float32(0.5)
    shift = two if contracted else one
    for block in numba.prange((len(origins) + BLOCK - 1) // BLOCK):
        for r in range(block * BLOCK, min(len(origins), (block + 1) * BLOCK)):
            if first[r + 1] == first[r]:
                continue
            ux, uy, uz = (origins[r, 0] - centre[0]) / half[0], (origins[r, 1] - centre[1]) / half[1], (origins[r, 2] - centre[2]) / half[2]
            vx, vy, vz = directions[r, 0] / half[0], directions[r, 1] / half[1], directions[r, 2] / half[2]
            for n in range(first[r], first[r + 1]):
                t = begins[r, n - first[r]]
                stretch = one
                if contracted:
                    reach = max(max(abs(ux + t * vx), abs(uy + t * vy)), max(abs(uz + t * vz), one))
                    stretch = reach * reach
                size = min(step * stretch, leave[r] - t)
                at = t + offset[r] * size
                px, py, pz = ux + at * vx, uy + at * vy, uz + at * vz
                if contracted:
                    m = max(max(abs(px), abs(py)), max(abs(pz), one))
                    f = (two - one / m) / m
                    px, py, pz = px * f, py * f, pz * f
                start[n], extent[n], length[n] = t, size, size / stretch
                point[n, 0], point[n, 1], point[n, 2] = (px + shift) * scale, (py + shift) * scale, (pz + shift) * scale


def valid_samples(origins, directions, near, far, offset, centre, half, contracted, step, slots, voxels, threshold, whole=0):  # type: ignore[no-untyped-def]
    """`efficientnerf.sampling.samples.valid_samples` on float32 arrays: (first, start, extent, length, point, tried)."""
    rays = len(origins)
    counts, tried, leave = np.zeros(rays, np.int64), np.zeros(rays, np.int64), np.empty(rays, np.float32)
    begins = np.empty((rays, slots), np.float32)  # of a row only as much is touched as the ray has valid samples
    step = np.float32(step)
    limits = (np.float32(threshold), whole)
    _find_valid(origins, directions, near, far, offset, centre, half, contracted, step, slots, voxels, *limits, counts, tried, leave, begins)
    first = np.zeros(rays + 1, np.int64)
    np.cumsum(counts, out=first[1:])
    n = int(first[-1])
    start, extent, length, point = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32), np.empty((n, 3), np.float32)
    _write_valid(origins, directions, offset, centre, half, contracted, step, leave, begins, first, start, extent, length, point)
    return first, start, extent, length, point, int(tried.sum())


@numba.njit(cache=True, parallel=True, error_model="numpy")
def select_pivots(weight, first, threshold, most, out):  # type: ignore[no-untyped-def]
    """`efficientnerf.sampling.samples.select_pivots`: out (N,) bool."""
    rays = len(first) - 1
    for block in numba.prange((rays + BLOCK - 1) // BLOCK):
        for r in range(block * BLOCK, min(rays, (block + 1) * BLOCK)):
            lo, hi = first[r], first[r + 1]
            count = 0
            for n in range(lo, hi):
                out[n] = weight[n] > threshold
                count += out[n]
            if count <= most:
                continue
            least = np.sort(weight[lo:hi])[hi - lo - most]  # the lightest weight that stays
            heavier = 0
            for n in range(lo, hi):
                heavier += weight[n] > least
            for n in range(lo, hi):
                stays = weight[n] > least
                if weight[n] == least and heavier < most:
                    stays = True
                    heavier += 1
                out[n] = out[n] and stays


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _pivotal(  # type: ignore[no-untyped-def]
    origins, directions, offset, centre, half, contracted, first, start, extent, length, pivotal, per_pivot,
    fine_first, fine_start, fine_extent, fine_length, point,
):  # fmt: skip
    one, two = np.float32(1), np.float32(2)
    scale = np.float32(0.25) if contracted else np.float32(0.5)
    shift = two if contracted else one
    for block in numba.prange((len(origins) + BLOCK - 1) // BLOCK):
        for r in range(block * BLOCK, min(len(origins), (block + 1) * BLOCK)):
            n = fine_first[r]
            for i in range(first[r], first[r + 1]):
                if not pivotal[i]:
                    continue
                size, part = extent[i] / np.float32(per_pivot), length[i] / np.float32(per_pivot)
                for s in range(per_pivot):
                    begin = start[i] + np.float32(s) * size
                    at = begin + offset[r] * size
                    px = (origins[r, 0] + at * directions[r, 0] - centre[0]) / half[0]
                    py = (origins[r, 1] + at * directions[r, 1] - centre[1]) / half[1]
                    pz = (origins[r, 2] + at * directions[r, 2] - centre[2]) / half[2]
                    if contracted:
                        m = max(max(abs(px), abs(py)), max(abs(pz), one))
                        f = (two - one / m) / m
                        px, py, pz = px * f, py * f, pz * f
                    fine_start[n], fine_extent[n], fine_length[n] = begin, size, part
                    point[n, 0], point[n, 1], point[n, 2] = (px + shift) * scale, (py + shift) * scale, (pz + shift) * scale
                    n += 1


def pivotal_samples(origins, directions, offset, centre, half, contracted, first, start, extent, length, pivotal, per_pivot):  # type: ignore[no-untyped-def]
    """`efficientnerf.sampling.samples.pivotal_samples` on arrays: (first, start, extent, length, point)."""
    total = np.concatenate([np.zeros(1, np.int64), np.cumsum(pivotal, dtype=np.int64)])
    fine_first = total[first] * per_pivot
    n = int(fine_first[-1])
    fine_start, fine_extent, fine_length, point = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32), np.empty((n, 3), np.float32)
    _pivotal(
        origins, directions, offset, centre, half, contracted, first, start, extent, length, pivotal, per_pivot,
        fine_first, fine_start, fine_extent, fine_length, point,
    )  # fmt: skip
    return fine_first, fine_start, fine_extent, fine_length, point
