"""Which Gaussians a tile of an image shows, nearest first (numba).

A tile is TILE x TILE pixels, of sixteen blocks of 4 x 4. A pair is a Gaussian in a tile: its mask has a bit for each block, row by row, that the Gaussian may
touch: those that its ellipse meets, by rows of blocks. The pairs of a tile follow each other by depth; Gaussians of one depth by number.

P pairs, N Gaussians, T tiles.
"""

from typing import NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.splat_layout import CONIC_A, CONIC_B, CONIC_C, DEPTH, HEIGHT, REACH, TILE, WIDTH, X, Y

BLOCK = 4
GAUSSIANS_A_TASK = 1024
DIGITS, DIGIT = 3, 11  # of the depths' bits, that they are sorted by


class Pairs(NamedTuple):
    """The pairs of an image."""

    begin: np.ndarray  # (T + 1,) int64: the first of each tile, row by row
    gaussian: np.ndarray  # (P,) int32
    mask: np.ndarray  # (P,) int32
    slot: np.ndarray  # (P,) int32: number of the pair among those of all Gaussians, one Gaussian's after the other's
    first: np.ndarray  # (N + 1,) int64: the first slot of each Gaussian
    columns: int  # tiles along a row


@numba.njit(cache=True, error_model="numpy")
def _by_depth(records, order, other, counts):  # type: ignore[no-untyped-def]
    """Numbers of the Gaussians in the image by depth, in `order` or `other`: radix sort, which keeps the order of equals."""
    count = 0
    for n in range(len(records)):
        if records[n, WIDTH] > 0:
            order[count] = n
            count += 1
    bits, base = records.view(np.uint32), (1 << DIGIT) - 1
    for digit in range(DIGITS):
        counts[:] = 0
        shift = np.uint32(digit * DIGIT)
        for m in range(count):
            counts[1 + ((bits[order[m], DEPTH] >> shift) & base)] += 1
        for n in range(1, len(counts)):
            counts[n] += counts[n - 1]
        for m in range(count):
            key = (bits[order[m], DEPTH] >> shift) & base
            other[counts[key]] = order[m]
            counts[key] += 1
        order, other = other, order
    return order[:count]


@numba.njit(cache=True, inline="always", error_model="numpy")
def _range(centre, reach, side, end):  # type: ignore[no-untyped-def]
    """First cell of `side` pixels that centre - reach to centre + reach meets, and the one after the last."""
    return max(0, int((centre - reach) / side)), min(end, int((centre + reach) / side) + 1)


@numba.njit(cache=True, error_model="numpy")
def _count(records, columns, rows, begin, first):  # type: ignore[no-untyped-def]
    side = np.float32(TILE)
    for n in range(len(records)):
        first[n + 1] = first[n]
        if records[n, WIDTH] > 0:
            left, right = _range(records[n, X], records[n, WIDTH], side, columns)
            top, bottom = _range(records[n, Y], records[n, HEIGHT], side, rows)
            first[n + 1] += max(0, right - left) * max(0, bottom - top)
            for row in range(top, bottom):
                for column in range(left, right):
                    begin[row * columns + column + 1] += 1
    for tile in range(1, len(begin)):
        begin[tile] += begin[tile - 1]


@numba.njit(cache=True, inline="always", error_model="numpy")
def _ellipse(record):  # type: ignore[no-untyped-def]
    """What `_across` needs of a Gaussian, float64: its place, 1 / a and b of its conic, determinant, squared reach times a, and how far down its
    rightmost point is."""
    a, b, c = float(record[CONIC_A]), float(record[CONIC_B]), float(record[CONIC_C])
    # `raster` finds q in float32, from terms that cancel in a needle: its error is a share of them.
    square = 1.001 * float(record[REACH]) + 1e-6 * (a * float(record[WIDTH]) ** 2 + c * float(record[HEIGHT]) ** 2)
    determinant = a * c - b * b
    return float(record[X]), float(record[Y]), 1 / a, b, determinant, a * square, -b * np.sqrt(square / (c * determinant))


@numba.njit(cache=True, inline="always", error_model="numpy")
def _across(ellipse, row, begin, end):  # type: ignore[no-untyped-def]
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


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _masks(records, columns, rows, first, masks):  # type: ignore[no-untyped-def]
    """Blocks of each pair, (P,) by slot."""
    for task in numba.prange((len(records) + GAUSSIANS_A_TASK - 1) // GAUSSIANS_A_TASK):
        side, block = np.float32(TILE), np.float32(BLOCK)
        for n in range(task * GAUSSIANS_A_TASK, min(len(records), (task + 1) * GAUSSIANS_A_TASK)):
            if first[n + 1] > first[n]:
                masks[first[n] : first[n + 1]] = 0
                left, right = _range(records[n, X], records[n, WIDTH], side, columns)
                begin, end = _range(records[n, X], records[n, WIDTH], block, 4 * columns)
                top, bottom = _range(records[n, Y], records[n, HEIGHT], block, 4 * rows)
                ellipse = _ellipse(records[n])
                for row in range(top, bottom):
                    low, high = _across(ellipse, row, begin, end)
                    slot = first[n] + (row // 4 - top // 4) * (right - left)
                    for column in range(low // 4, (high + 3) // 4):
                        bits = ((1 << min(high - 4 * column, 4)) - 1) & ~((1 << max(low - 4 * column, 0)) - 1)
                        masks[slot + column - left] |= bits << 4 * (row % 4)


@numba.njit(cache=True, error_model="numpy")
def _fill(records, order, columns, rows, begin, first, masks, gaussian, mask, slot):  # type: ignore[no-untyped-def]
    next_of, side = begin.copy(), np.float32(TILE)
    for m in range(len(order)):
        n = order[m]
        left, right = _range(records[n, X], records[n, WIDTH], side, columns)
        top, bottom = _range(records[n, Y], records[n, HEIGHT], side, rows)
        number = first[n]
        for row in range(top, bottom):
            for column in range(left, right):
                at = next_of[row * columns + column]
                next_of[row * columns + column] += 1
                gaussian[at], slot[at], mask[at] = n, number, masks[number]
                number += 1


@numba.njit(cache=True, error_model="numpy")
def _pairs(records, columns, rows):  # type: ignore[no-untyped-def]
    count = len(records)
    begin, first = np.zeros(columns * rows + 1, np.int64), np.zeros(count + 1, np.int64)
    _count(records, columns, rows, begin, first)
    order = _by_depth(records, np.empty(count, np.int32), np.empty(count, np.int32), np.empty((1 << DIGIT) + 1, np.int64))
    masks = np.empty(begin[-1], np.int32)
    _masks(records, columns, rows, first, masks)
    gaussian, mask, slot = np.empty(begin[-1], np.int32), np.empty(begin[-1], np.int32), np.empty(begin[-1], np.int32)
    _fill(records, order, columns, rows, begin, first, masks, gaussian, mask, slot)
    return begin, gaussian, mask, slot, first


def pairs_of(records: np.ndarray, width: int, height: int) -> Pairs:
    """The pairs of projected Gaussians (N, RECORD) in an image."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    begin, gaussian, mask, slot, first = _pairs(records, columns, rows)
    return Pairs(begin, gaussian, mask, slot, first, columns)
