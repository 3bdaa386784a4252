"""Images of projected Gaussians, and how an image's error changes with each of them (numba, all cores).

From front to back, as 3DGS:

    alpha_i = min(0.99, o_i exp(-q_i / 2)), none below 1/255        colour = sum_i T_i alpha_i c_i        T_(i+1) = T_i (1 - alpha_i)

and a pixel ends before T would fall below 1e-4. Lanes are the sixteen pixels of a block, so that what is summed stays in registers from the first Gaussian
to the last. The sums of a Gaussian over a tile's pixels are its pair's own: no two threads add to one number, and the result does not depend on their number.

P pairs, N Gaussians, H x W pixels.
"""

import numpy as np

from efficientnerf.backends import splat_layout as layout
from efficientnerf.backends.layout import SSIM_C1, SSIM_C2
from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.splats.pairs import BLOCK, Pairs
from efficientnerf.backends.numba.splats.projection import LANES
from efficientnerf.backends.numba.vector.maths import (
    LOG2_E,
    bits_of,
    broadcast,
    exp2_neg,
    lowest_bit,
    mask_of,
    maximum,
    minimum,
    select,
    sqrt,
    sum_each,
    sum_lanes,
)
from efficientnerf.backends.numba.vector.memory import fetch_add, load, load_three, pointer, store, store_three
from efficientnerf.backends.splat_layout import RECORD, SUMS, TILE, Picture
from efficientnerf.backends.structure import structure_change

_NONE, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
_C1, _C2 = np.float32(SSIM_C1), np.float32(SSIM_C2)
_structure_change = numba.njit(inline="always", error_model="numpy")(structure_change)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _strength(p, at, x, y):
    """What a Gaussian hides of pixels before it is capped."""
    dx, dy = x - p[at + layout.X], y - p[at + layout.Y]
    q = dx * (dx * p[at + layout.CONIC_A] + dy * (_TWO * p[at + layout.CONIC_B])) + dy * dy * p[at + layout.CONIC_C]
    return exp2_neg(maximum(q * (_HALF * LOG2_E), _NONE)) * p[at + layout.ALPHA]


@numba.njit(cache=True, inline="always", error_model="numpy")
def _covered(strength, light, open_):
    """Of a Gaussian over pixels that are open: alpha, the light behind it, where it shows, and which pixels stay open."""
    alpha = minimum(strength, layout.MOST_ALPHA)
    left = light * (_ONE - alpha)
    counts = open_ & (alpha >= layout.LEAST_ALPHA)
    ends = counts & (left < layout.LEAST_TRANSMITTANCE)
    return alpha, left, counts & ~ends, open_ & ~ends


@numba.njit(cache=True, inline="always", error_model="numpy")
def _blend(p, bit, first, end, gaussian, mask, x, y, open_, met, strengths, place):
    """A block front to back: colour and transmittance to `place`; returns how many pairs were met, whose numbers go to `met`, and what they hide before it is
    capped, zero where they do not count, to `strengths`."""
    red, green, blue, light = broadcast(_NONE, LANES), broadcast(_NONE, LANES), broadcast(_NONE, LANES), broadcast(_ONE, LANES)
    count, closed = 0, False
    for begin in range(first, end, LANES):
        here = bits_of((load(mask, begin, LANES) & bit) != 0) & ((1 << min(LANES, end - begin)) - 1)
        while here != 0:
            pair = begin + lowest_bit(here)
            here &= here - 1
            at = np.int64(gaussian[pair]) * RECORD
            strength = _strength(p, at, x, y)
            alpha, left, counts, open_ = _covered(strength, light, open_)
            if bits_of(counts) != 0:
                weight = select(counts, light * alpha, _NONE)
                red, green, blue = red + weight * p[at + layout.RED], green + weight * p[at + layout.RED + 1], blue + weight * p[at + layout.RED + 2]
                light = select(counts, left, light)
                met[count] = pair
                store(strengths, count * LANES, select(counts, strength, _NONE))
                count += 1
            if bits_of(open_) == 0:
                closed = True
                break
        if closed:
            break
    store_three(place, 0, LANES, red, green, blue)
    store(place, 48, light)
    return count


@numba.njit(cache=True, inline="always", error_model="numpy")
def _pixels(left, top, width, height, xs, ys):
    """Centres of the pixels of a block into `xs` and `ys`, and bits of those in the image."""
    inside = 0
    for lane in range(16):
        column, row = left + lane % BLOCK, top + lane // BLOCK
        xs[lane], ys[lane] = np.float32(column) + _HALF, np.float32(row) + _HALF
        if column < width and row < height:
            inside |= 1 << lane
    return np.int64(inside)


@numba.njit(cache=True, error_model="numpy")
def _render_tile(tile, p, pairs, width, height, met, strengths, place, xs, ys, colour, transmittance):
    row, column = tile // pairs.columns, tile % pairs.columns
    for block in range(16):
        left, top = column * TILE + block % 4 * BLOCK, row * TILE + block // 4 * BLOCK
        if left < width and top < height:
            open_ = mask_of(_pixels(left, top, width, height, xs, ys), LANES)
            x, y = load(pointer(xs), 0, LANES), load(pointer(ys), 0, LANES)
            _blend(p, 1 << block, pairs.begin[tile], pairs.begin[tile + 1], pairs.gaussian, pointer(pairs.mask), x, y, open_, met, strengths, pointer(place))
            for lane in range(16):
                i, j = top + lane // BLOCK, left + lane % BLOCK
                if i < height and j < width:
                    for channel in range(3):
                        colour[i, j, channel] = place[16 * channel + lane]
                    transmittance[i, j] = place[48 + lane]


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _render(begin, end, workers, task, records, pairs, longest, colour, transmittance):
    for _ in numba.prange(workers):
        met, place = np.empty(longest, np.int64), np.empty(64, np.float32)
        xs, ys, strengths = np.empty(16, np.float32), np.empty(16, np.float32), np.empty(longest * LANES, np.float32)
        tile = begin + fetch_add(pointer(task), 0, 1)
        while tile < end:
            _render_tile(tile, pointer(records), pairs, colour.shape[1], colour.shape[0], met, pointer(strengths), place, xs, ys, colour, transmittance)
            tile = begin + fetch_add(pointer(task), 0, 1)


@numba.njit(cache=True, error_model="numpy")
def _loss_slopes(p, picture, structure):
    """Half of the derivatives of a block's squared error become those of its loss; with structure, 1 - SSIM of the block, which is a window of it, is in
    that; p: pointer to `slopes`."""
    share, per_delta = _ONE / np.float32(LANES), _ONE / (picture.huber_delta * picture.huber_delta)
    weight = _ONE / sqrt(load(p, 64, LANES) * per_delta + _ONE)
    by_light = load(p, 48, LANES) * weight
    for channel in range(3):
        difference, y = load(p, 16 * channel, LANES), load(p, 80 + 16 * channel, LANES)
        slope = difference * weight
        if structure:
            x = y + difference
            of_x, of_y = sum_lanes(x) * share, sum_lanes(y) * share
            x, y = x - of_x, y - of_y
            change = _structure_change(x, y, of_x, of_y, sum_lanes(x * x + y * y) * share, sum_lanes(x * y) * share, _C1, _C2, _TWO)
            slope = slope - change * picture.structure
            by_light = by_light - change * (picture.structure * (_HALF if picture.over_all else picture.background[channel]))
        store(p, 16 * channel, slope)
    store(p, 48, by_light)


@numba.njit(cache=True, error_model="numpy")
def _residual(left, top, place, picture, slopes):
    """The squared error of a block, whose colours and transmittances are in `place`. Derivatives of the loss, structure included, go into the first 64 of
    `slopes`, each pixel's squared error into the next 16, and the colours wanted, over grey or the background, into the last 48.

    Over all backgrounds b from 0 to 1, d + t b has the mean square (d + t / 2)^2 + t^2 / 12: d a channel's difference, t that of the transmittances.
    """
    total, all_count = 0.0, True
    height, width = picture.mask.shape
    for lane in range(16):
        i, j = top + lane // BLOCK, left + lane % BLOCK
        by_light, error = _NONE, _NONE
        counts = i < height and j < width and picture.mask[i, j] != 0
        alpha = np.float32(picture.pixels[i, j, 3]) * np.float32(1 / 255) if counts and picture.over_all else _ONE
        for channel in range(3):
            slope, over_ground = _NONE, _NONE
            if counts:
                wanted = np.float32(picture.pixels[i, j, channel]) * np.float32(1 / 255) * alpha
                if picture.over_all:
                    more = place[48 + lane] - (_ONE - alpha)
                    slope = place[16 * channel + lane] - wanted + _HALF * more
                    over_ground = wanted + _HALF * (_ONE - alpha)
                    by_light += _HALF * slope + more * np.float32(1 / 12)
                    error += slope * slope + more * more * np.float32(1 / 12)
                else:
                    slope = place[16 * channel + lane] + place[48 + lane] * picture.background[channel] - wanted
                    over_ground = wanted
                    by_light += slope * picture.background[channel]
                    error += slope * slope
            slopes[16 * channel + lane], slopes[80 + 16 * channel + lane] = slope, over_ground
        slopes[48 + lane], slopes[64 + lane] = by_light, error
        total += float(error)
        all_count &= counts
    _loss_slopes(pointer(slopes), picture, all_count and picture.structure > _NONE)
    return total


@numba.njit(cache=True, inline="always", error_model="numpy")
def _pull(p, met, strengths, count, gaussian, slot, x, y, place, slopes, sums):
    """Sums of the pairs that a block met, added to theirs: what the error changes by, with -q / 2 (v), with that times distances (v dx, v dy, v dx dx, v dx dy,
    v dy dy) and with the colour; and the error where it shows."""
    by_red, by_green, by_blue = load_three(slopes, 0, LANES)
    red, green, blue = load_three(place, 0, LANES)
    behind = red * by_red + green * by_green + blue * by_blue + load(place, 48, LANES) * load(slopes, 48, LANES)
    error, light = load(slopes, 64, LANES), broadcast(_ONE, LANES)
    for n in range(count):
        pair = met[n]
        at = np.int64(gaussian[pair]) * RECORD
        dx, dy, strength = x - p[at + layout.X], y - p[at + layout.Y], load(strengths, n * LANES, LANES)
        alpha = minimum(strength, layout.MOST_ALPHA)
        rest, weight = _ONE - alpha, light * alpha
        gain = by_red * p[at + layout.RED] + by_green * p[at + layout.RED + 1] + by_blue * p[at + layout.RED + 2]
        behind = behind - weight * gain
        v = select(strength < layout.MOST_ALPHA, (light * gain - behind / rest) * alpha, _NONE)
        light = light * rest
        vx, vy = v * dx, v * dy
        to = np.int64(slot[pair]) * SUMS
        found = sum_each((v, vx, vy, vx * dx, vx * dy, vy * dy, weight * by_red, weight * by_green, weight * by_blue, weight * error))
        store(sums, to, load(sums, to, LANES) + found)


@numba.njit(cache=True, error_model="numpy")
def _fit_tile(tile, p, pairs, picture, met, strengths, place, slopes, xs, ys, sums):
    row, column, (height, width), total = tile // pairs.columns, tile % pairs.columns, picture.mask.shape, 0.0
    for pair in range(pairs.begin[tile], pairs.begin[tile + 1]):
        for n in range(SUMS):
            sums[pairs.slot[pair], n] = _NONE
    for block in range(16):
        left, top = column * TILE + block % 4 * BLOCK, row * TILE + block // 4 * BLOCK
        if left < width and top < height:
            inside = mask_of(_pixels(left, top, width, height, xs, ys), LANES)
            x, y = load(pointer(xs), 0, LANES), load(pointer(ys), 0, LANES)
            count = _blend(
                p, 1 << block, pairs.begin[tile], pairs.begin[tile + 1], pairs.gaussian, pointer(pairs.mask), x, y, inside, met, strengths, pointer(place)
            )
            total += _residual(left, top, place, picture, slopes)
            _pull(p, met, strengths, count, pairs.gaussian, pairs.slot, x, y, pointer(place), pointer(slopes), pointer(sums))
    return total


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _fit(begin, end, workers, task, records, pairs, longest, picture, sums, errors):
    for _ in numba.prange(workers):
        met, place, slopes = np.empty(longest, np.int64), np.empty(64, np.float32), np.empty(128, np.float32)
        xs, ys, strengths = np.empty(16, np.float32), np.empty(16, np.float32), np.empty(longest * LANES, np.float32)
        tile = begin + fetch_add(pointer(task), 0, 1)
        while tile < end:
            errors[tile] = _fit_tile(tile, pointer(records), pairs, picture, met, pointer(strengths), place, slopes, xs, ys, sums)
            tile = begin + fetch_add(pointer(task), 0, 1)


def _longest(pairs: Pairs) -> int:
    return int(np.diff(pairs.begin).max(initial=1))


def render_tiles(tiles: slice, records: np.ndarray, pairs: Pairs, colour: np.ndarray, transmittance: np.ndarray) -> None:
    """Pixels of some tiles: colour (H, W, 3) and transmittance (H, W) float32."""
    workers = min(numba.get_num_threads(), tiles.stop - tiles.start)
    _render(tiles.start, tiles.stop, workers, np.zeros(1, np.int64), records, pairs, _longest(pairs), colour, transmittance)


def fit_tiles(tiles: slice, records: np.ndarray, pairs: Pairs, picture: Picture, sums: np.ndarray, errors: np.ndarray) -> None:
    """The squared error of each of some tiles in `errors` (T,) float64, and sums of the loss's derivatives by their pairs, structure included, in `sums`
    (P, SUMS) float32."""
    workers = min(numba.get_num_threads(), tiles.stop - tiles.start)
    _fit(tiles.start, tiles.stop, workers, np.zeros(1, np.int64), records, pairs, _longest(pairs), picture, sums, errors)
