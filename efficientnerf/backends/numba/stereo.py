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
RANDOM = 3  # planes that are tried in each round: near the best one, nearer, anywhere
STEEPEST = 3.0  # tangent of a random plane's angle to the picture
WORST = 2.0  # of costs, which are 1 - the normalised cross-correlation
LEAST_DEPTH = np.float32(1e-6)  # in units of the reference's depth
_ZERO = np.float32(0)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _uniform(seed, x, y, k):
    """A number from 0 to 1 for a pixel (Jarzynski and Olano 2020, PCG hash)."""
    state = np.uint32(x) * np.uint32(1973) + np.uint32(y) * np.uint32(9277) + np.uint32(k) * np.uint32(26699) + np.uint32(seed) * np.uint32(362437)
    for _ in range(2):
        state = state * np.uint32(747796405) + np.uint32(2891336453)
        word = ((state >> ((state >> np.uint32(28)) + np.uint32(4))) ^ state) * np.uint32(277803737)
        state = (word >> np.uint32(22)) ^ word
    return np.float32(state >> np.uint32(8)) * np.float32(1 / 2**24)


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


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def begin_planes(grey, guess, nearest, farthest, seed, maps, shifts, quads, starts, shapes, planes, cost):
    """Planes (H, W, 3) and their cost (H, W): of `guess` (H, W, 3), whose inverse depths are zero where there is none, or random ones that agree better.

    grey      (H, W) float32, 0 to 255
    nearest   greatest inverse depth; farthest: the least one
    maps      (S, 3, 3) float32, shifts (S, 3): of pixels of the reference (x, y, 1) with the inverse depth w to a source's, maps @ pixel + shifts * w
    quads     int32 of all pictures' pixels, see `quads_of`; starts (S,), shapes (S, 2) int64 of the sources' in it
    """
    height, width = grey.shape
    texels = pointer(quads)
    for y in numba.prange(height):
        patch = _empty_patch()
        address = pointer(patch)
        for x in range(width):
            deviation = _reference_patch(grey, x, y, patch)
            planes[y, x, :] = guess[y, x, :]
            cost[y, x] = np.float32(WORST)
            if deviation < np.float32(LEAST_WEIGHTED):
                continue
            if guess[y, x, 0] > np.float32(0):
                cost[y, x] = _cost(x, y, guess[y, x, 0], guess[y, x, 1], guess[y, x, 2], address, deviation, maps, shifts, texels, starts, shapes)
            inverse = farthest + (nearest - farthest) * _uniform(seed, x, y, 0)
            other = _cost(x, y, inverse, np.float32(0), np.float32(0), address, deviation, maps, shifts, texels, starts, shapes)
            if other < cost[y, x]:
                cost[y, x] = other
                planes[y, x, 0], planes[y, x, 1], planes[y, x, 2] = inverse, np.float32(0), np.float32(0)
        hold((patch,))


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def improve_planes(grey, nearest, farthest, focal, seed, maps, shifts, quads, starts, shapes, planes, cost):
    """One round over the pixels of both colours, in place; `focal` is the reference's in pixels, `seed` another in each round; else as of `begin_planes`."""
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
                w, gx, gy, least = planes[y, x, 0], planes[y, x, 1], planes[y, x, 2], cost[y, x]
                for k in range(len(AROUND)):
                    i, j = y + AROUND[k][1], x + AROUND[k][0]
                    if i < 0 or j < 0 or i >= height or j >= width or cost[i, j] >= np.float32(1):
                        continue
                    ow = planes[i, j, 0] + planes[i, j, 1] * np.float32(x - j) + planes[i, j, 2] * np.float32(y - i)
                    ox, oy = planes[i, j, 1], planes[i, j, 2]
                    if ow < farthest or ow > nearest:
                        continue
                    other = _cost(x, y, ow, ox, oy, address, deviation, maps, shifts, texels, starts, shapes)
                    if other < least:
                        w, gx, gy, least = ow, ox, oy, other
                width_of = np.float32(1)
                for k in range(RANDOM):
                    draw = 3 * k + 1
                    r0, r1, r2 = _uniform(seed, x, y, draw), _uniform(seed, x, y, draw + 1), _uniform(seed, x, y, draw + 2)
                    two = np.float32(2)
                    if k == RANDOM - 1:
                        ow = farthest + (nearest - farthest) * r0
                        steep = np.float32(STEEPEST) * ow / focal
                        ox, oy = steep * (two * r1 - np.float32(1)), steep * (two * r2 - np.float32(1))
                    else:
                        width_of *= np.float32(0.25)
                        ow = w * (np.float32(1) + np.float32(0.1) * width_of * (two * r0 - np.float32(1)))
                        steep = width_of * np.float32(STEEPEST) * w / focal
                        ox, oy = gx + steep * (two * r1 - np.float32(1)), gy + steep * (two * r2 - np.float32(1))
                    if ow < farthest or ow > nearest:
                        continue
                    other = _cost(x, y, ow, ox, oy, address, deviation, maps, shifts, texels, starts, shapes)
                    if other < least:
                        w, gx, gy, least = ow, ox, oy, other
                planes[y, x, 0], planes[y, x, 1], planes[y, x, 2] = w, gx, gy
                cost[y, x] = least
            hold((patch,))


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def confirm_depths(inverse, cost, worst, apart, maps, shifts, backs, back_shifts, inverses, starts, shapes, out):
    """Which sources' own depths confirm a pixel's: bits of out (H, W) int32, by source.

    A pixel goes to the source by its depth and back by the source's: it has to come back within `apart` pixels. Costs beyond `worst` confirm nothing.

    inverse      (H, W) float32 inverse depths of the reference, cost (H, W)
    maps, shifts to the sources as of `begin_planes`; backs, back_shifts from them
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
