"""Valid and pivotal samples of rays (EfficientNeRF, sections 3.3 and 3.4) on the CPU (numba, all cores).

The reference is `efficientnerf.sampling.samples`. Rays are split into fixed blocks and each ray belongs to one thread: results depend neither on timing nor
on the number of threads.

R rays, N samples, D density voxels a side. In unit coordinates a space's box is [-1, 1]^3.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from efficientnerf.backends.layout import RayBundle, SampleColumns
from efficientnerf.backends.numba.compositing import activate_density
from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.vector.maths import absolute, bits_of, broadcast, lowest_bit, maximum, minimum, select, to_int32
from efficientnerf.backends.numba.vector.memory import gather, load, pointer, store
from efficientnerf.geometry.spaces import FARTHEST

BLOCK = 64  # rays per task
LANES = 16  # rays that are marched at once
LOOKED_AT = 4, 12, 2**62  # numbers of a ray's samples up to which densities are asked for at a time
# Rows of the state, (ROWS, LANES) float32: origin and direction in unit coordinates; distance along the ray, and where the ray leaves the space; offset of a
# sample in its interval; threshold of the density voxels; number of intervals visited; start of the last of them.
UX, UY, UZ, VX, VY, VZ, T, T_EXIT, OFFSET, THRESHOLD, VISITED, START, ROWS = range(13)
_NONE, _QUARTER, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.25), np.float32(0.5), np.float32(1), np.float32(2)


class Box(NamedTuple):
    """A space: the centre (3,) and half the size (3,) of its box, float32, and whether it is contracted."""

    centre: np.ndarray
    half: np.ndarray
    contracted: bool


@numba.njit(cache=True, inline="always", error_model="numpy")
def _unit_to_grid(x, y, z, contracted):
    """Grid coordinates, [0, 1]^3, of a point in unit coordinates; contraction: Barron et al. 2022, "mip-NeRF 360", equation 10, with the maximum norm."""
    one, two = np.float32(1), np.float32(2)
    if contracted:
        norm = max(max(abs(x), abs(y)), max(abs(z), one))
        factor = (two - one / norm) / norm
        x, y, z = x * factor, y * factor, z * factor
    shift, scale = two if contracted else one, np.float32(0.25) if contracted else np.float32(0.5)
    return (x + shift) * scale, (y + shift) * scale, (z + shift) * scale


@numba.njit(cache=True, inline="always", error_model="numpy")
def _row(state, n):
    return load(state, n * LANES, LANES)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _point_at(state, t):
    """Points at distances along the rays, unit coordinates."""
    return _row(state, UX) + t * _row(state, VX), _row(state, UY) + t * _row(state, VY), _row(state, UZ) + t * _row(state, VZ)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _norm(x, y, z):
    """Maximum norm, at least 1."""
    return maximum(maximum(absolute(x), absolute(y)), maximum(absolute(z), _ONE))


@numba.njit(cache=True, inline="always", error_model="numpy")
def _along(x, side):
    """Number of the voxel at a grid coordinate along an axis; 0 for NaN."""
    return to_int32(minimum(maximum(x * np.float32(side), _NONE), np.float32(side - 1)))


@numba.njit(cache=True, inline="always", error_model="numpy")
def _next_intervals(state, voxels, side, step, farthest, contracted):
    """Advance each ray by one interval: bit n of the result is set where ray n had not left the space, bit LANES + n where the interval is valid.

    state, voxels  pointers to the rows above and to (side, side, side) float32
    contracted     a literal. In the box an interval is `step` long, and a ray ends at T_EXIT; in contracted space it grows beyond the box with the square of
                   the norm, and a ray ends where 1 / norm is below `farthest`, too
    """
    t, visited = _row(state, T), _row(state, VISITED)
    active, length = t < _row(state, T_EXIT), broadcast(step, LANES)
    if contracted:
        x, y, z = _point_at(state, t)
        norm = _norm(x, y, z)
        active, length = active & (norm * farthest <= _ONE), length * (norm * norm)
    x, y, z = _point_at(state, t + _row(state, OFFSET) * minimum(length, _row(state, T_EXIT) - t))
    shift, scale = _ONE, _HALF
    if contracted:
        norm = _norm(x, y, z)
        factor = (_TWO - _ONE / norm) / norm
        x, y, z = x * factor, y * factor, z * factor
        shift, scale = _TWO, _QUARTER
    i, j, k = _along((x + shift) * scale, side), _along((y + shift) * scale, side), _along((z + shift) * scale, side)
    valid = active & (gather(voxels, (i * side + j) * side + k) > _row(state, THRESHOLD))
    store(state, START * LANES, t)
    store(state, T * LANES, select(active, t + length, t))
    store(state, VISITED * LANES, select(active, visited + _ONE, visited))
    return bits_of(active) | bits_of(valid) << LANES


@numba.njit(cache=True, inline="always", error_model="numpy")
def _init_lane(origins, directions, near, far, centre, half, contracted, r, state, lane):
    """Write ray r, clipped to the box of a bounded space, to a lane of the state of `_next_intervals`."""
    ux, uy, uz = (origins[r, 0] - centre[0]) / half[0], (origins[r, 1] - centre[1]) / half[1], (origins[r, 2] - centre[2]) / half[2]
    vx, vy, vz = directions[r, 0] / half[0], directions[r, 1] / half[1], directions[r, 2] / half[2]
    tiny = np.float32(1e-12)
    one = np.float32(1)
    t, t_exit = near[r], far[r]
    if not contracted:
        sx = vx if abs(vx) >= tiny else tiny
        sy = vy if abs(vy) >= tiny else tiny
        sz = vz if abs(vz) >= tiny else tiny
        ax, bx = (-one - ux) / sx, (one - ux) / sx
        ay, by = (-one - uy) / sy, (one - uy) / sy
        az, bz = (-one - uz) / sz, (one - uz) / sz
        t = max(max(min(ax, bx), min(ay, by)), max(min(az, bz), near[r]))
        t_exit = min(min(max(ax, bx), max(ay, by)), min(max(az, bz), far[r]))
    state[UX, lane], state[UY, lane], state[UZ, lane] = ux, uy, uz
    state[VX, lane], state[VY, lane], state[VZ, lane] = vx, vy, vz
    state[T, lane], state[T_EXIT, lane] = t, t_exit


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _find_valid(rays, box, step, max_intervals, voxels, threshold, unpruned, counts, visited, t_exit, starts):
    """March rays in groups of one per SIMD lane; writes the starts (R, max_intervals) of valid intervals, and of each ray how many are valid and visited."""
    (origins, directions, near, far, offset), (centre, half, contracted) = rays, box
    farthest, never, side, grid = np.float32(FARTHEST), np.float32(-np.inf), voxels.shape[0], pointer(voxels)
    for block in numba.prange((len(origins) + LANES - 1) // LANES):
        begin, end = block * LANES, min(len(origins), (block + 1) * LANES)
        state = np.zeros((ROWS, LANES), np.float32)  # a lane without a ray is past its exit
        for r in range(begin, end):
            _init_lane(origins, directions, near, far, centre, half, contracted, r, state, r - begin)
            state[OFFSET, r - begin], state[THRESHOLD, r - begin] = offset[r], never if r < unpruned else threshold
        p_state = pointer(state)
        for _ in range(max_intervals):
            if contracted:
                masks = _next_intervals(p_state, grid, side, step, farthest, True)
            else:
                masks = _next_intervals(p_state, grid, side, step, farthest, False)
            if masks == 0:
                break
            valid = masks >> LANES
            while valid != 0:
                lane = lowest_bit(valid)
                valid &= valid - 1
                r = begin + lane
                starts[r, counts[r]] = state[START, lane]
                counts[r] += 1
        for r in range(begin, end):
            visited[r], t_exit[r] = np.int64(state[VISITED, r - begin]), state[T_EXIT, r - begin]


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _write_valid(rays, box, step, t_exit, starts, first, start, extent, length, point):
    """Pack the intervals that `_find_valid` found."""
    (origins, directions, _near, _far, offset), (centre, half, contracted) = rays, box
    one = np.float32(1)
    for block in numba.prange((len(origins) + BLOCK - 1) // BLOCK):
        for r in range(block * BLOCK, min(len(origins), (block + 1) * BLOCK)):
            if first[r + 1] == first[r]:
                continue
            ux, uy, uz = (origins[r, 0] - centre[0]) / half[0], (origins[r, 1] - centre[1]) / half[1], (origins[r, 2] - centre[2]) / half[2]
            vx, vy, vz = directions[r, 0] / half[0], directions[r, 1] / half[1], directions[r, 2] / half[2]
            for n in range(first[r], first[r + 1]):
                t = starts[r, n - first[r]]
                growth = one
                if contracted:
                    norm = max(max(abs(ux + t * vx), abs(uy + t * vy)), max(abs(uz + t * vz), one))
                    growth = norm * norm
                size = min(step * growth, t_exit[r] - t)
                at = t + offset[r] * size
                start[n], extent[n], length[n] = t, size, size / growth
                point[n, 0], point[n, 1], point[n, 2] = _unit_to_grid(ux + at * vx, uy + at * vy, uz + at * vz, contracted)


def valid_samples(bundle: RayBundle, box: Box, step: float, max_intervals: int, voxels: np.ndarray, threshold: float, unpruned: int = 0) -> tuple[Any, ...]:
    """`efficientnerf.sampling.valid.valid_samples` on float32 arrays: (first, start, extent, length, point, number of intervals visited)."""
    rays = len(bundle.origins)
    counts, visited, t_exit = np.zeros(rays, np.int64), np.zeros(rays, np.int64), np.empty(rays, np.float32)
    starts = np.empty((rays, max_intervals), np.float32)  # pages of a row are touched only as far as the ray has valid samples
    stride = np.float32(step)
    _find_valid(bundle, box, stride, max_intervals, voxels, np.float32(threshold), unpruned, counts, visited, t_exit, starts)
    first = np.zeros(rays + 1, np.int64)
    np.cumsum(counts, out=first[1:])
    n = int(first[-1])
    start, extent, length, point = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32), np.empty((n, 3), np.float32)
    _write_valid(bundle, box, stride, t_exit, starts, first, start, extent, length, point)
    return first, start, extent, length, point, int(visited.sum())


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def select_pivots(weight, first, threshold, max_pivots, out):
    """`efficientnerf.sampling.pivotal.select_pivots` into out (N,) bool."""
    rays = len(first) - 1
    for block in numba.prange((rays + BLOCK - 1) // BLOCK):
        for r in range(block * BLOCK, min(rays, (block + 1) * BLOCK)):
            begin, end = first[r], first[r + 1]
            count = 0
            for n in range(begin, end):
                out[n] = weight[n] > threshold
                count += out[n]
            if count <= max_pivots:
                continue
            cutoff = np.sort(weight[begin:end])[end - begin - max_pivots]  # the lowest weight that may stay
            selected = 0
            for n in range(begin, end):
                selected += weight[n] > cutoff
            for n in range(begin, end):
                keep = weight[n] > cutoff
                if weight[n] == cutoff and selected < max_pivots:
                    keep = True
                    selected += 1
                out[n] = out[n] and keep


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _write_pivotal(rays, box, first, coarse, pivotal, per_pivot, fine_first, fine_start, fine_extent, fine_length, point):
    """Divides the pivotal ones of the samples `coarse`."""
    (origins, directions, _near, _far, offset), (centre, half, contracted), (start, extent, length, _point) = rays, box, coarse
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
                    x = (origins[r, 0] + at * directions[r, 0] - centre[0]) / half[0]
                    y = (origins[r, 1] + at * directions[r, 1] - centre[1]) / half[1]
                    z = (origins[r, 2] + at * directions[r, 2] - centre[2]) / half[2]
                    fine_start[n], fine_extent[n], fine_length[n] = begin, size, part
                    point[n, 0], point[n, 1], point[n, 2] = _unit_to_grid(x, y, z, contracted)
                    n += 1


def pivotal_samples(bundle: RayBundle, box: Box, first: np.ndarray, coarse: SampleColumns, pivotal: np.ndarray, per_pivot: int) -> tuple[np.ndarray, ...]:
    """`efficientnerf.sampling.pivotal.pivotal_samples` on arrays: (first, start, extent, length, point)."""
    total = np.concatenate([np.zeros(1, np.int64), np.cumsum(pivotal, dtype=np.int64)])
    fine_first = total[first] * per_pivot
    n = int(fine_first[-1])
    fine_start, fine_extent, fine_length, point = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32), np.empty((n, 3), np.float32)
    _write_pivotal(bundle, box, first, coarse, pivotal, per_pivot, fine_first, fine_start, fine_extent, fine_length, point)
    return fine_first, fine_start, fine_extent, fine_length, point


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _gather_points(point, first, begin, rows, out):
    """The points of samples of each ray from number `begin` on, as many as `rows` (R + 1,) says, end to end."""
    rays = len(rows) - 1
    for block in numba.prange((rays + BLOCK - 1) // BLOCK):
        for r in range(block * BLOCK, min(rays, (block + 1) * BLOCK)):
            ahead = first[r] + begin - rows[r]
            for n in range(rows[r], rows[r + 1]):
                out[n, 0], out[n, 1], out[n, 2] = point[ahead + n, 0], point[ahead + n, 1], point[ahead + n, 2]


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _absorb(raw, length, first, begin, rows, exponential, deepest, depth, counts):
    """Adds to the optical depth of each ray that of these samples, up to `deepest`, and to `counts` how many begin before it."""
    rays = len(rows) - 1
    for block in numba.prange((rays + BLOCK - 1) // BLOCK):
        for r in range(block * BLOCK, min(rays, (block + 1) * BLOCK)):
            n, ahead = rows[r], first[r] + begin - rows[r]
            while n < rows[r + 1] and depth[r] < deepest:
                depth[r] += activate_density(raw[n], exponential)[0] * length[ahead + n]
                n += 1
            counts[r] += n - rows[r]


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _write_first(first, columns, kept, start, extent, length, point):
    """The first samples of each ray, as many as `kept` (R + 1,) says, end to end."""
    old_start, old_extent, old_length, old_point = columns
    rays = len(kept) - 1
    for block in numba.prange((rays + BLOCK - 1) // BLOCK):
        for r in range(block * BLOCK, min(rays, (block + 1) * BLOCK)):
            back = first[r] - kept[r]
            for n in range(kept[r], kept[r + 1]):
                start[n], extent[n], length[n] = old_start[back + n], old_extent[back + n], old_length[back + n]
                point[n, 0], point[n, 1], point[n, 2] = old_point[back + n, 0], old_point[back + n, 1], old_point[back + n, 2]


def visible_samples(
    first: np.ndarray, columns: SampleColumns, density: Callable[[np.ndarray], np.ndarray], exponential: bool, least: float
) -> tuple[np.ndarray, ...]:
    """`efficientnerf.sampling.visible.visible_samples` on arrays: (first, start, extent, length, point). Most rays end at their first samples: the densities of
    others are asked for where these let light through."""
    depth, counts = np.zeros(len(first) - 1, np.float32), np.zeros(len(first) - 1, np.int64)
    deepest, begin = np.float32(-np.log(least)), 0
    for end in LOOKED_AT:
        ahead = np.where(depth < deepest, np.clip(np.diff(first), begin, end) - begin, 0)
        rows = np.concatenate([np.zeros(1, np.int64), np.cumsum(ahead)])
        points = np.empty((int(rows[-1]), 3), np.float32)
        _gather_points(columns.point, first, begin, rows, points)
        _absorb(density(points), columns.length, first, begin, rows, exponential, deepest, depth, counts)
        begin = end
    kept = np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)])
    n = int(kept[-1])
    out = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32), np.empty((n, 3), np.float32)
    _write_first(first, columns, kept, *out)
    return kept, *out
