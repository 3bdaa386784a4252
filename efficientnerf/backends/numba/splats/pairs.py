"""Which Gaussians a tile of an image shows, nearest first (numba).

A tile is TILE x TILE pixels, of sixteen blocks of 4 x 4. A pair is a Gaussian in a tile: its mask has a bit for each block, row by row, that the Gaussian may
touch. The pairs of a tile follow each other by depth; Gaussians of one depth by number.

P pairs, N Gaussians, T tiles.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.splats.projection import DEPTH, HEIGHT, WIDTH, X, Y

TILE, BLOCK = 16, 4
DIGITS, DIGIT = 3, 11  # of the depths' bits, that they are sorted by


class Pairs(NamedTuple):
    """The pairs of an image.

    begin     (T + 1,) int64: the first of each tile, row by row
    gaussian  (P,) int32
    mask      (P,) int32
    slot      (P,) int32: number of the pair among those of all Gaussians, one Gaussian's after the other's
    first     (N + 1,) int64: the first slot of each Gaussian
    columns   tiles along a row
    """

    begin: np.ndarray
    gaussian: np.ndarray
    mask: np.ndarray
    slot: np.ndarray
    first: np.ndarray
    columns: int


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


@numba.njit(cache=True, error_model="numpy")
def _fill(records, order, columns, rows, begin, first, gaussian, mask, slot):  # type: ignore[no-untyped-def]
    next_of, side, block = begin.copy(), np.float32(TILE), np.float32(BLOCK)
    for m in range(len(order)):
        n = order[m]
        left, right = _range(records[n, X], records[n, WIDTH], side, columns)
        top, bottom = _range(records[n, Y], records[n, HEIGHT], side, rows)
        block_left, block_right = _range(records[n, X], records[n, WIDTH], block, 4 * columns)
        block_top, block_bottom = _range(records[n, Y], records[n, HEIGHT], block, 4 * rows)
        number = first[n]
        for row in range(top, bottom):
            low, high = max(block_top - 4 * row, 0), min(block_bottom - 4 * row, 4)
            lines = ((1 << (4 * high)) - 1) & ~((1 << (4 * low)) - 1)
            for column in range(left, right):
                low, high = max(block_left - 4 * column, 0), min(block_right - 4 * column, 4)
                across = ((1 << high) - 1) & ~((1 << low) - 1)
                at = next_of[row * columns + column]
                next_of[row * columns + column] += 1
                gaussian[at], slot[at] = n, number
                mask[at] = lines & (across * 0x1111)
                number += 1


@numba.njit(cache=True, error_model="numpy")
def _pairs(records, columns, rows):  # type: ignore[no-untyped-def]
    count = len(records)
    begin, first = np.zeros(columns * rows + 1, np.int64), np.zeros(count + 1, np.int64)
    _count(records, columns, rows, begin, first)
    order = _by_depth(records, np.empty(count, np.int32), np.empty(count, np.int32), np.empty((1 << DIGIT) + 1, np.int64))
    gaussian, mask, slot = np.empty(begin[-1], np.int32), np.empty(begin[-1], np.int32), np.empty(begin[-1], np.int32)
    _fill(records, order, columns, rows, begin, first, gaussian, mask, slot)
    return begin, gaussian, mask, slot, first


def pairs_of(records: np.ndarray, width: int, height: int) -> Pairs:
    """The pairs of projected Gaussians (N, RECORD) in an image."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    begin, gaussian, mask, slot, first = _pairs(records, columns, rows)
    return Pairs(begin, gaussian, mask, slot, first, columns)
