"""Depths of photographs by PatchMatch stereo (numba): each pixel's plane is found among its neighbours' and random ones, by how well patches agree.

Bleyer et al. 2011, "PatchMatch Stereo"; Galliani et al. 2015, "Massively parallel multiview stereopsis by surface normal diffusion" (checkerboard order,
several views); the patches' weights are bilateral. A plane is the inverse depth (along the camera's axis) as an affine function of the pixel: its value
there, and what it changes with x and with y. One colour of the checkerboard is changed at a time from what the other one holds, and random numbers are a
hash of where they are used: the result does not depend on the number of threads.

H, W pixels of the reference, S sources. Pictures are undistorted; the first pixel's centre is at (0, 0).
"""

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.vector.maths import bits_of, fma, sum_lanes, to_float32, to_int32
from efficientnerf.backends.numba.vector.memory import gather, hold, load, pointer

REACH, STEP = 4, 2  # of a patch: pixels to either side, from one sample to the next
SIDE = 2 * REACH // STEP + 1
AREA = SIDE * SIDE
LANES = 32  # as many as samples, or more: those have no weight
ALL = (1 << LANES) - 1
SQUARES = SIDE * sum(a * a for a in range(-REACH, REACH + 1, STEP))  # of the samples' distances along one axis
ALONE = 0.3  # most that the second best source counts as worse than the best: it may not see the surface
LEAST_DEVIATION = 2.0  # of 255: deviation of a patch from a gradient, below which it shows nothing
LEAST_WEIGHTED = 0.5  # of 255: weighted deviation of a patch, below which its noise decides
COLOUR, SPREAD = 24.0, 5.0  # of a patch's weights: of 255, pixels
AROUND = ((-1, 0), (1, 0), (0, -1), (0, 1), (-3, 0), (3, 0), (0, -3), (0, 3))  # neighbours of the other colour
RANDOM = 3  # planes that are tried in each round
STEEPEST = 3.0  # tangent of a random plane's angle to the picture
WORST = 2.0  # of costs, which are 1 - the normalised cross-correlation
LEAST_DEPTH = np.float32(1e-6)  # in units of the reference's depth
_ZERO = np.float32(0)
_LOW = np.uint64(2**32 - 1)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _uniform(seed, x, y, k):
    """A number from 0 to 1 for a pixel (Jarzynski and Olano 2020, PCG hash). numba multiplies uint32 as uint64."""
    state = np.uint64(x * 1973 + y * 9277 + k * 26699 + seed * 362437) & _LOW
    for _ in range(2):
        state = (state * np.uint64(747796405) + np.uint64(2891336453)) & _LOW
        word = (((state >> ((state >> np.uint64(28)) + np.uint64(4))) ^ state) * np.uint64(277803737)) & _LOW
        state = (word >> np.uint64(22)) ^ word
    return np.float32(state >> np.uint64(8)) * np.float32(1 / 2**24)


def quads_of(grey: np.ndarray) -> np.ndarray:
    """(H, W) int32 of uint8 (H, W): a pixel, the one to its right, and the two below these, from the lowest byte on; a border is continued."""
    wide = np.pad(grey, ((0, 1), (0, 1)), mode="edge")
    return np.ascontiguousarray(np.stack([wide[:-1, :-1], wide[:-1, 1:], wide[1:, :-1], wide[1:, 1:]], axis=-1)).view(np.int32)[..., 0]


@numba.njit(cache=True, inline="always", error_model="numpy")
def _empty_patch():
    patch = np.zeros(4 * LANES, np.float32)
    n = 0
    for b in range(-REACH, REACH + 1, STEP):
        for a in range(-REACH, REACH + 1, STEP):
            patch[n], patch[LANES + n] = a, b
            n += 1
    return patch


@numba.njit(cache=True, inline="always", error_model="numpy")
def _reference_patch(grey, x, y, patch):
    """`patch` of 4 times `LANES`: where its samples are, their values less the weighted mean, and weights, which sum to 1. Returns the deviation, or zero
    where it shows nothing but a gradient."""
    values, weights = patch[2 * LANES :], patch[3 * LANES :]
    height, width = grey.shape
    middle, total, mean = grey[y, x], np.float32(0), np.float32(0)
    plain = squares = across = down = np.float32(0)
    n = 0
    for b in range(-REACH, REACH + 1, STEP):
        row = min(max(y + b, 0), height - 1)
        for a in range(-REACH, REACH + 1, STEP):
            value = grey[row, min(max(x + a, 0), width - 1)]
            apart = abs(value - middle) * np.float32(1 / COLOUR) + np.float32((a * a + b * b) / (2 * SPREAD * SPREAD))
            weight = np.exp(-apart)
            values[n], weights[n] = value, weight
            total += weight
            mean += weight * value
            change = value - middle
            plain += change
            squares += change * change
            across += change * np.float32(a)
            down += change * np.float32(b)
            n += 1
    rest = squares - plain * plain * np.float32(1 / AREA) - (across * across + down * down) * np.float32(1 / SQUARES)
    if rest < np.float32(AREA * LEAST_DEVIATION * LEAST_DEVIATION):
        return np.float32(0)
    mean /= total
    variance = np.float32(0)
    for n in range(AREA):
        weights[n] /= total
        values[n] -= mean
        variance += weights[n] * values[n] * values[n]
    return np.sqrt(variance)


@numba.njit(cache=True, error_model="numpy")
def _cost(x, y, inverse, along, down, patch, deviation, maps, shifts, quads, starts, shapes):
    """How little the sources agree with the patch on a plane, from 0 to `WORST`: the best one, and by less the next."""
    best, second = np.float32(1), np.float32(1)  # a source that does not show the patch says nothing
    at = inverse - along * np.float32(x) - down * np.float32(y)  # inverse depth of the first pixel
    u, v = load(patch, 0, LANES) + np.float32(x), load(patch, LANES, LANES) + np.float32(y)
    values, weights = load(patch, 2 * LANES, LANES), load(patch, 3 * LANES, LANES)
    for s in range(len(maps)):
        across, over, deep = shifts[s, 0], shifts[s, 1], shifts[s, 2]
        depth = fma(maps[s, 2, 0] + deep * along, u, fma(maps[s, 2, 1] + deep * down, v, maps[s, 2, 2] + deep * at))
        near = fma(maps[s, 0, 0] + across * along, u, fma(maps[s, 0, 1] + across * down, v, maps[s, 0, 2] + across * at)) / depth
        high = fma(maps[s, 1, 0] + over * along, u, fma(maps[s, 1, 1] + over * down, v, maps[s, 1, 2] + over * at)) / depth
        height, width = np.float32(shapes[s, 0] - 1), np.float32(shapes[s, 1] - 1)
        shown = (depth > LEAST_DEPTH) & (near >= _ZERO) & (high >= _ZERO) & (near < width) & (high < height)
        if bits_of(shown) != ALL:
            continue
        j, i = to_int32(near), to_int32(high)
        texels = gather(quads, i * np.int32(shapes[s, 1]) + j + np.int32(starts[s]))
        near, high = near - to_float32(j), high - to_float32(i)
        upper, lower = to_float32(texels & 255), to_float32((texels >> 16) & 255)
        upper = fma(near, to_float32((texels >> 8) & 255) - upper, upper)
        lower = fma(near, to_float32((texels >> 24) & 255) - lower, lower)
        value = fma(high, lower - upper, upper)
        weighted = weights * value
        mean = sum_lanes(weighted)
        variance = sum_lanes(weighted * value) - mean * mean
        if variance < np.float32(LEAST_WEIGHTED * LEAST_WEIGHTED):
            continue
        cost = np.float32(1) - sum_lanes(weighted * values) / (deviation * np.sqrt(variance))
        if cost < best:
            best, second = cost, best
        elif cost < second:
            second = cost
    return best + np.float32(0.5) * min(second - best, np.float32(ALONE))


@numba.njit(cache=True, inline="always", error_model="numpy")
def _of_neighbour(planes, cost, x, y, k):
    """The plane of the k-th neighbour at a pixel; zeros where it has none that fits."""
    i, j = y + AROUND[k][1], x + AROUND[k][0]
    if i < 0 or j < 0 or i >= len(planes) or j >= planes.shape[1] or cost[i, j] >= np.float32(1):
        return _ZERO, _ZERO, _ZERO
    along, down = planes[i, j, 1], planes[i, j, 2]
    return planes[i, j, 0] + along * np.float32(x - j) + down * np.float32(y - i), along, down


@numba.njit(cache=True, inline="always", error_model="numpy")
def _random(k, x, y, w, wx, wy, nearest, farthest, focal, seed):
    """The k-th random plane of a pixel: two near its own, the second of them nearer, and one anywhere."""
    two, one = np.float32(2), np.float32(1)
    a, b, c = _uniform(seed, x, y, 3 * k), two * _uniform(seed, x, y, 3 * k + 1) - one, two * _uniform(seed, x, y, 3 * k + 2) - one
    if k == RANDOM - 1:
        w = farthest + (nearest - farthest) * a
        steep = np.float32(STEEPEST) * w / focal
        return w, steep * b, steep * c
    reach = np.float32(0.25) if k == 0 else np.float32(0.0625)
    steep = reach * np.float32(STEEPEST) * w / focal
    return w * (one + np.float32(0.1) * reach * (two * a - one)), wx + steep * b, wy + steep * c


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def improve_planes(grey, nearest, farthest, focal, seed, maps, shifts, quads, starts, shapes, planes, cost):
    """One round over the pixels of both colours, in place: planes (H, W, 3) and what they cost (H, W) float32, `WORST` where that is not known yet.

    grey      (H, W) float32, 0 to 255
    nearest   greatest inverse depth; farthest: the least one; focal: focal length in pixels
    seed      of random planes, another in each round
    maps      (S, 3, 3) float32, shifts (S, 3): of pixels of the reference (x, y, 1) with the inverse depth w to a source's, maps @ pixel + shifts * w
    quads     int32 of all pictures' pixels, see `quads_of`; starts (S,), shapes (S, 2) int64 of the sources' in it
    """
    height, width = grey.shape
    texels = pointer(quads)
    for colour in range(2):
        for y in numba.prange(height):
            patch = _empty_patch()
            address = pointer(patch)
            for x in range((y + colour) & 1, width, 2):
                deviation = _reference_patch(grey, x, y, patch)
                if deviation < np.float32(LEAST_WEIGHTED):
                    continue
                w, wx, wy, least = planes[y, x, 0], planes[y, x, 1], planes[y, x, 2], cost[y, x]
                for k in range(0 if least == np.float32(WORST) else 1, 1 + len(AROUND) + RANDOM):
                    if k == 0:
                        other = w, wx, wy
                    elif k <= len(AROUND):
                        other = _of_neighbour(planes, cost, x, y, k - 1)
                    else:
                        other = _random(k - 1 - len(AROUND), x, y, w, wx, wy, nearest, farthest, focal, seed)
                    if other[0] < farthest or other[0] > nearest:
                        continue
                    found = _cost(x, y, other[0], other[1], other[2], address, deviation, maps, shifts, texels, starts, shapes)
                    if found < least:
                        least = found
                        w, wx, wy = other
                planes[y, x, 0], planes[y, x, 1], planes[y, x, 2] = w, wx, wy
                cost[y, x] = least
            hold((patch,))


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def confirm_depths(inverse, cost, worst, apart, maps, shifts, backs, back_shifts, inverses, starts, shapes, out):
    """Which sources' own depths confirm a pixel's: bits of out (H, W) int32, by source.

    A pixel goes to the source by its depth and back by the source's: it has to come back within `apart` pixels. Costs beyond `worst` confirm nothing.

    inverse      (H, W) float32 inverse depths of the reference, cost (H, W)
    maps, shifts to the sources as of `improve_planes`; backs, back_shifts from them
    inverses     float32 of all pictures: inverse depths, zero where they are not known
    """
    height, width = inverse.shape
    for y in numba.prange(height):
        for x in range(width):
            out[y, x] = 0
            if cost[y, x] > worst or inverse[y, x] <= np.float32(0):
                continue
            for s in range(len(maps)):
                w, u, v = inverse[y, x], np.float32(x), np.float32(y)
                depth = maps[s, 2, 0] * u + maps[s, 2, 1] * v + maps[s, 2, 2] + shifts[s, 2] * w
                if depth <= np.float32(1e-6):
                    continue
                px = (maps[s, 0, 0] * u + maps[s, 0, 1] * v + maps[s, 0, 2] + shifts[s, 0] * w) / depth
                py = (maps[s, 1, 0] * u + maps[s, 1, 1] * v + maps[s, 1, 2] + shifts[s, 1] * w) / depth
                j, i = int(np.floor(px + np.float32(0.5))), int(np.floor(py + np.float32(0.5)))
                if i < 0 or j < 0 or i >= shapes[s, 0] or j >= shapes[s, 1]:
                    continue
                own = inverses[starts[s] + i * shapes[s, 1] + j]
                if own <= np.float32(0):
                    continue
                depth = backs[s, 2, 0] * px + backs[s, 2, 1] * py + backs[s, 2, 2] + back_shifts[s, 2] * own
                if depth <= np.float32(1e-6):
                    continue
                qx = (backs[s, 0, 0] * px + backs[s, 0, 1] * py + backs[s, 0, 2] + back_shifts[s, 0] * own) / depth
                qy = (backs[s, 1, 0] * px + backs[s, 1, 1] * py + backs[s, 1, 2] + back_shifts[s, 1] * own) / depth
                if (qx - u) ** 2 + (qy - v) ** 2 <= apart * apart:
                    out[y, x] |= np.int32(1) << np.int32(s)
