"""Which Gaussians a tile of an image shows, nearest first (numba).

A tile is TILE x TILE pixels, of sixteen blocks of 4 x 4. A pair is a Gaussian in a tile: its mask has a bit for each block, row by row, that the Gaussian may
touch: those that its ellipse meets, by rows of blocks. The pairs of a tile follow each other by depth; Gaussians of one depth by number. They are found by
parts of the Gaussians, and sorted by tiles, on all cores.

P pairs, N Gaussians, T tiles.
"""

from typing import NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.splat_layout import CONIC_A, CONIC_B, CONIC_C, DEPTH, HEIGHT, LANES, REACH, TILE, WIDTH, X, Y

BLOCK = 4
PARTS = 64  # of the Gaussians, whose pairs are found at the same time
TILES_A_TASK = 8
DIGIT = 8  # bits of depths that are sorted at a time


class Pairs(NamedTuple):
    """The pairs of an image."""

    begin: np.ndarray  # (T + 1,) int64: the first of each tile, row by row
    gaussian: np.ndarray  # (P,) int32
    mask: np.ndarray  # (P + LANES,) int32: whole vectors are read, and what is beyond P is not looked at
    slot: np.ndarray  # (P,) int32: number of the pair among those of all Gaussians, one Gaussian's after the other's
    first: np.ndarray  # (N + 1,) int64: the first slot of each Gaussian
    columns: int  # tiles along a row


@numba.njit(cache=True, inline="always", error_model="numpy")
def _range(centre, reach, side, end):
    """First cell of `side` pixels that centre - reach to centre + reach meets, and the one after the last."""
    return max(0, int((centre - reach) / side)), min(end, int((centre + reach) / side) + 1)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _tiles_of(record, columns, rows):
    """Tiles that a Gaussian may touch: the first column, the one after the last, and rows as well; none of one that is not in the image."""
    if not record[WIDTH] > 0:
        return 0, 0, 0, 0
    side = np.float32(TILE)
    return *_range(record[X], record[WIDTH], side, columns), *_range(record[Y], record[HEIGHT], side, rows)


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _count(records, columns, rows, length, counts, first):
    """Pairs of each part of the Gaussians and tile in `counts` (PARTS, T), and of each Gaussian in `first` from 1 on."""
    for part in numba.prange(PARTS):
        for n in range(part * length, min(len(records), (part + 1) * length)):
            left, right, top, bottom = _tiles_of(records[n], columns, rows)
            first[n + 1] = max(0, right - left) * max(0, bottom - top)
            for row in range(top, bottom):
                for column in range(left, right):
                    counts[part, row * columns + column] += 1


@numba.njit(cache=True, error_model="numpy")
def _sum_up(counts, begin, first):
    """Counts become the first pair of each part in each tile, those of a tile in the order of the parts."""
    total = 0
    for tile in range(counts.shape[1]):
        begin[tile] = total
        for part in range(PARTS):
            count = counts[part, tile]
            counts[part, tile] = total
            total += count
    begin[counts.shape[1]] = total
    for n in range(1, len(first)):
        first[n] += first[n - 1]


@numba.njit(cache=True, inline="always", error_model="numpy")
def _ellipse(record):
    """What `_across` needs of a Gaussian, float64: its place, 1 / a and b of its conic, determinant, squared reach times a, and how far down its
    rightmost point is."""
    a, b, c = float(record[CONIC_A]), float(record[CONIC_B]), float(record[CONIC_C])
    # `raster` finds q in float32, from terms that cancel in a needle: its error is a share of them.
    square = 1.001 * float(record[REACH]) + 1e-6 * (a * float(record[WIDTH]) ** 2 + c * float(record[HEIGHT]) ** 2)
    determinant = a * c - b * b
    return float(record[X]), float(record[Y]), 1 / a, b, determinant, a * square, -b * np.sqrt(square / (c * determinant))


@numba.njit(cache=True, inline="always", error_model="numpy")
def _across(ellipse, row, begin, end):
    """Of the blocks `begin` to `end` of a row of blocks, the first with the centre of a pixel in the ellipse, and the one after the last."""
    x, y, per_a, b, determinant, square, down = ellipse
    if not determinant > 0:  # float32 holds no such ellipse
        return begin, end
    above, below = BLOCK * row + 0.5 - y, BLOCK * row + BLOCK - 0.5 - y
    right, left = min(max(down, above), below), min(max(-down, above), below)
    to_right, to_left = square - determinant * right * right, square - determinant * left * left
    if to_right < 0 or to_left < 0:
        return end, end
    first, last = x - (b * left + np.sqrt(to_left)) * per_a - 0.5, x - (b * right - np.sqrt(to_right)) * per_a - 0.5
    if first >= BLOCK * begin:
        begin = int(min(first / BLOCK, float(end)))
    if last < BLOCK * end:
        end = int(np.floor(max(last / BLOCK, begin - 1.0))) + 1
    return begin, end


@numba.njit(cache=True, inline="always", error_model="numpy")
def _masks(record, tiles, columns, rows, masks):
    """Blocks of the tiles of a Gaussian, row by row."""
    left, right, tile_row, _bottom = tiles
    begin, end = _range(record[X], record[WIDTH], np.float32(BLOCK), 4 * columns)
    top, bottom = _range(record[Y], record[HEIGHT], np.float32(BLOCK), 4 * rows)
    ellipse = _ellipse(record)
    for n in range(len(masks)):
        masks[n] = 0
    for row in range(top, bottom):
        low, high = _across(ellipse, row, begin, end)
        slot = (row // 4 - tile_row) * (right - left)
        for column in range(low // 4, (high + 3) // 4):
            bits = ((1 << min(high - 4 * column, 4)) - 1) & ~((1 << max(low - 4 * column, 0)) - 1)
            masks[slot + column - left] |= bits << 4 * (row % 4)


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _fill(records, columns, rows, length, counts, first, masks, keys, gaussian):
    """Masks (P,) by slot; and of the pairs of each tile, by number, `keys`, their depth's bits above their slot, and their Gaussians (P,)."""
    bits = records.view(np.uint32)
    for part in numba.prange(PARTS):
        for n in range(part * length, min(len(records), (part + 1) * length)):
            if first[n + 1] > first[n]:
                tiles, slot = _tiles_of(records[n], columns, rows), first[n]
                _masks(records[n], tiles, columns, rows, masks[slot : first[n + 1]])
                for row in range(tiles[2], tiles[3]):
                    for tile in range(row * columns + tiles[0], row * columns + tiles[1]):
                        at = counts[part, tile]
                        counts[part, tile] = at + 1
                        gaussian[at], keys[at] = n, np.uint64(bits[n, DEPTH]) << np.uint64(32) | np.uint64(slot)
                        slot += 1


@numba.njit(cache=True, error_model="numpy")
def _sort(keys, other, gaussian, other_gaussian, counts):
    """Radix sort by the upper half of the keys, which keeps the order of equals; returns whether the result is in the other arrays."""
    swapped = False
    for digit in range(32, 64, DIGIT):
        shift, base = np.uint64(digit), np.uint64((1 << DIGIT) - 1)
        counts[:] = 0
        for n in range(len(keys)):
            counts[np.int64(keys[n] >> shift & base) + 1] += 1
        if counts[np.int64(keys[0] >> shift & base) + 1] == len(keys):
            continue
        for n in range(1, len(counts)):
            counts[n] += counts[n - 1]
        for n in range(len(keys)):
            key = np.int64(keys[n] >> shift & base)
            other[counts[key]], other_gaussian[counts[key]] = keys[n], gaussian[n]
            counts[key] += 1
        keys, other, gaussian, other_gaussian, swapped = other, keys, other_gaussian, gaussian, not swapped
    return swapped


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _by_depth(begin, masks, keys, gaussian, other, other_gaussian, mask, slot):
    """The pairs of each tile by depth, nearest first; of `keys` and `gaussian` as `_fill` leaves them. The arrays `other` are scratch."""
    tiles = len(begin) - 1
    for task in numba.prange((tiles + TILES_A_TASK - 1) // TILES_A_TASK):
        counts = np.empty((1 << DIGIT) + 1, np.int64)
        for tile in range(task * TILES_A_TASK, min(tiles, (task + 1) * TILES_A_TASK)):
            low, high = begin[tile], begin[tile + 1]
            if high > low and _sort(keys[low:high], other[low:high], gaussian[low:high], other_gaussian[low:high], counts):
                for n in range(low, high):
                    keys[n], gaussian[n] = other[n], other_gaussian[n]
            for n in range(low, high):
                slot[n] = np.int32(keys[n] & np.uint64(0xFFFFFFFF))
                mask[n] = masks[slot[n]]


@numba.njit(cache=True, error_model="numpy")
def _pairs(records, columns, rows):
    length, tiles = (len(records) + PARTS - 1) // PARTS, columns * rows
    counts, begin, first = np.zeros((PARTS, tiles), np.int64), np.empty(tiles + 1, np.int64), np.zeros(len(records) + 1, np.int64)
    _count(records, columns, rows, length, counts, first)
    _sum_up(counts, begin, first)
    count = begin[tiles]
    masks, mask, slot = np.empty(count, np.int32), np.empty(count + LANES, np.int32), np.empty(count, np.int32)
    keys, gaussian = np.empty(count, np.uint64), np.empty(count, np.int32)
    _fill(records, columns, rows, length, counts, first, masks, keys, gaussian)
    _by_depth(begin, masks, keys, gaussian, np.empty(count, np.uint64), np.empty(count, np.int32), mask, slot)
    return begin, gaussian, mask, slot, first


def pairs_of(records: np.ndarray, width: int, height: int) -> Pairs:
    """The pairs of projected Gaussians (N, RECORD) in an image."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    begin, gaussian, mask, slot, first = _pairs(records, columns, rows)
    return Pairs(begin, gaussian, mask, slot, first, columns)
