"""The training step's kernels on the CPU (numba, all cores): same results as the torch functions they stand for.

Parallel without races: rays are split into fixed blocks, and a ray belongs to one thread. So the bytes depend neither on timing nor on the number of
threads.
"""

from __future__ import annotations

import numba
import numpy as np

from efficientnerf.backends.numba import intervals
from efficientnerf.backends.numba.intervals import RAYS
from efficientnerf.backends.numba.simd import pointer
from efficientnerf.rendering.compositing import LARGEST_LOGIT
from efficientnerf.sampling.samples import FARTHEST

BLOCK = 64  # rays per task
PRIME_Y, PRIME_Z = np.uint32(2654435761), np.uint32(805459861)  # Mueller et al. 2022, section 3


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
def pivots(weight, first, threshold, most, out):  # type: ignore[no-untyped-def]
    """`efficientnerf.sampling.samples.pivots`: out (N,) bool."""
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


@numba.njit(cache=True, inline="always", error_model="numpy")
def density_of(x, exponential):  # type: ignore[no-untyped-def]
    """Density and its derivative."""
    one = np.float32(1)
    if exponential:
        if x > np.float32(LARGEST_LOGIT):
            return np.exp(np.float32(LARGEST_LOGIT)), np.float32(0)
        y = np.exp(x)
        return y, y
    z = x - one
    e = np.exp(-abs(z))
    return max(z, np.float32(0)) + np.log1p(e), (one if z >= 0 else e) / (one + e)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def composite(raw, length, first, harmonics, background, exponential, colour, opacity, distortion, weight, rgb):  # type: ignore[no-untyped-def]
    """`efficientnerf.rendering.compositing.composite`, forward."""
    terms = harmonics.shape[1]
    one = np.float32(1)
    rays = len(first) - 1
    for block in numba.prange((rays + BLOCK - 1) // BLOCK):
        for r in range(block * BLOCK, min(rays, (block + 1) * BLOCK)):
            light = one
            c0 = c1 = c2 = np.float32(0)
            at = spread = near_weight = near_moment = np.float32(0)
            for n in range(first[r], first[r + 1]):
                density, _ = density_of(raw[n, 0], exponential)
                alpha = one - np.exp(-density * length[n])
                w = light * alpha
                light *= one - alpha
                for channel in range(3):
                    total = np.float32(0)
                    for k in range(terms):
                        total += harmonics[r, k] * raw[n, 1 + channel * terms + k]
                    rgb[n, channel] = one / (one + np.exp(-total))
                c0 += w * rgb[n, 0]
                c1 += w * rgb[n, 1]
                c2 += w * rgb[n, 2]
                weight[n] = w
                middle = at + np.float32(0.5) * length[n]
                spread += np.float32(2) * w * (middle * near_weight - near_moment) + w * w * length[n] / np.float32(3)
                near_weight += w
                near_moment += w * middle
                at += length[n]
            distortion[r] = spread
            colour[r, 0] = c0 + light * background[r, 0]
            colour[r, 1] = c1 + light * background[r, 1]
            colour[r, 2] = c2 + light * background[r, 2]
            opacity[r] = one - light


@numba.njit(cache=True, inline="always", error_model="numpy")
def _pull(g0, g1, g2, rgb, gs, w, length, middle, near_weight, near_moment, all_weight, all_moment):  # type: ignore[no-untyped-def]
    """Gradient with respect to a sample's weight: of the colours, and of the distortion, 2 sum_j w_j |s - s_j| + 2/3 w l."""
    two = np.float32(2)
    far_weight, far_moment = all_weight - near_weight - w, all_moment - near_moment - w * middle
    spread = two * (middle * near_weight - near_moment + far_moment - middle * far_weight) + two / np.float32(3) * w * length
    return g0 * rgb[0] + g1 * rgb[1] + g2 * rgb[2] + gs * spread


@numba.njit(cache=True, parallel=True, error_model="numpy")
def composite_backward(  # type: ignore[no-untyped-def]
    raw, length, first, harmonics, background, exponential, weight, rgb,
    grad_colour, grad_opacity, grad_distortion, grad_weight, grad_raw, grad_background,
):  # fmt: skip
    """Gradients of colour, opacity, distortion and weights with respect to raw and background."""
    terms = harmonics.shape[1]
    one = np.float32(1)
    rays = len(first) - 1
    for block in numba.prange((rays + BLOCK - 1) // BLOCK):
        for r in range(block * BLOCK, min(rays, (block + 1) * BLOCK)):
            g0, g1, g2 = grad_colour[r, 0], grad_colour[r, 1], grad_colour[r, 2]
            behind = g0 * background[r, 0] + g1 * background[r, 1] + g2 * background[r, 2] - grad_opacity[r]
            # What lies behind sample n contributes `rest`: the background's share and the samples', front to back from the total.
            light = one
            rest = np.float32(0)
            at = all_weight = all_moment = np.float32(0)
            gs = grad_distortion[r]
            for n in range(first[r], first[r + 1]):
                light -= weight[n]
                all_weight += weight[n]
                all_moment += weight[n] * (at + np.float32(0.5) * length[n])
                at += length[n]
            at = near_weight = near_moment = np.float32(0)
            for n in range(first[r], first[r + 1]):
                middle = at + np.float32(0.5) * length[n]
                pull = _pull(g0, g1, g2, rgb[n], gs, weight[n], length[n], middle, near_weight, near_moment, all_weight, all_moment)
                rest += weight[n] * (grad_weight[n] + pull)
                near_weight += weight[n]
                near_moment += weight[n] * middle
                at += length[n]
            light = max(light, np.float32(0))
            rest += light * behind
            grad_background[r, 0], grad_background[r, 1], grad_background[r, 2] = light * g0, light * g1, light * g2
            before = one
            at = near_weight = near_moment = np.float32(0)
            for n in range(first[r], first[r + 1]):
                density, slope = density_of(raw[n, 0], exponential)
                w = weight[n]
                middle = at + np.float32(0.5) * length[n]
                own = grad_weight[n] + _pull(g0, g1, g2, rgb[n], gs, w, length[n], middle, near_weight, near_moment, all_weight, all_moment)
                near_weight += w
                near_moment += w * middle
                at += length[n]
                rest -= w * own
                after = before * np.exp(-density * length[n])
                grad_raw[n, 0] = (after * own - rest) * length[n] * slope
                before = after
                for channel in range(3):
                    g = g0 if channel == 0 else (g1 if channel == 1 else g2)
                    c = rgb[n, channel]
                    d = w * g * c * (one - c)
                    for k in range(terms):
                        grad_raw[n, 1 + channel * terms + k] = d * harmonics[r, k]


@numba.njit(cache=True, parallel=True, error_model="numpy")
def ray_directions(lookup, begin, knots, stride, pixel, width, rotation, view, out):  # type: ignore[no-untyped-def]
    """Directions in the world of pixels of several views: rotation[view] applied to what lies between the knots of the view's lens.

    begin, knots, width  of each view: where its table begins, how many knots a row of it has, and pixels a row
    """
    one = np.float32(1)
    for n in numba.prange(len(view)):
        v = view[n]
        row, column = pixel[n] // width[v], pixel[n] % width[v]
        at = begin[v] + row // stride * knots[v] + column // stride
        x, y, z = lookup[at, 0], lookup[at, 1], lookup[at, 2]
        if stride > 1:
            f, g = np.float32(column % stride) / np.float32(stride), np.float32(row % stride) / np.float32(stride)
            right, below = at + (1 if f > 0 else 0), knots[v] if g > 0 else 0
            a, b, c, d = (one - g) * (one - f), (one - g) * f, g * (one - f), g * f
            x = a * x + b * lookup[right, 0] + c * lookup[at + below, 0] + d * lookup[right + below, 0]
            y = a * y + b * lookup[right, 1] + c * lookup[at + below, 1] + d * lookup[right + below, 1]
            z = a * z + b * lookup[right, 2] + c * lookup[at + below, 2] + d * lookup[right + below, 2]
            length = np.sqrt(x * x + y * y + z * z)
            x, y, z = x / length, y / length, z / length
        for axis in range(3):
            out[n, axis] = rotation[v, axis, 0] * x + rotation[v, axis, 1] * y + rotation[v, axis, 2] * z
