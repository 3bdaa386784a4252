"""In which order the tensors of the layout `packed` are coded, and the context of each symbol: one walk for reading and writing.

Values of what was coded before predict what follows: those of the cells or voxels one step back along x, y and z, which always come first.
FORMAT.md, section 14.

B bricks, N stored voxels, b voxels along a side of a brick.
"""

from __future__ import annotations

import numpy as np

from efficientnerf.backends.numba.entropy.rans import FAILED, coded
from efficientnerf.backends.numba.runtime import numba

BIT_CONTEXTS = 128  # which of seven neighbours are set
DENSITY_CONTEXTS = 33
BASE_CONTEXTS = 8 + 64 + 64  # green; red; blue
REPEAT_CONTEXTS, CODE_CONTEXTS, LOW_CONTEXTS = 7 * 16, 10 * 16, 256  # of a group: whether a code is a neighbour's; its leading byte; the other one
NEW = 3  # symbol: the code of no neighbour


DIGITS = np.array([n.bit_length() for n in range(256)], np.int64)  # binary digits
# Of a sum of the digits of so many numbers: 1 and their mean, rounded down; 0 of none.
MEAN_DIGITS = np.array([[0] * 25, *([1 + digits // count for digits in range(25)] for count in (1, 2, 3))], np.int64)


@numba.njit(cache=True, error_model="numpy")
def walk_cells(coder, cells, begin, end):  # type: ignore[no-untyped-def]
    """Planes `begin` to `end` of a grid along x.

    cells  (X + 1, Y + 1, Z + 1) uint8, 1 where one is occupied; the first plane, row and column are 0
    """
    reads, state, words, table, symbol_of, shares, symbols, contexts = coder
    _, ny, nz = cells.shape
    for x in range(begin + 1, end + 1):
        for y in range(1, ny):
            for z in range(1, nz):
                a, b, c = cells[x - 1, y, z], cells[x, y - 1, z], cells[x, y, z - 1]
                d, e, f, g = cells[x - 1, y - 1, z], cells[x - 1, y, z - 1], cells[x, y - 1, z - 1], cells[x - 1, y - 1, z - 1]
                context = a | b << 1 | c << 2 | d << 3 | e << 4 | f << 5 | g << 6
                value = coded(reads, state, words, table, symbol_of, shares, symbols, contexts, context, cells[x, y, z])
                if value > 1:
                    state[FAILED] = 1
                cells[x, y, z] = value & 1


@numba.njit(inline="always")
def _slot(p, q, r, b):  # type: ignore[no-untyped-def]
    return (p * b + q) * b + r


@numba.njit(cache=True, error_model="numpy")
def walk_masks(coder, stored, before, b, begin, end):  # type: ignore[no-untyped-def]
    """Bricks `begin` to `end`.

    stored  (B, b^3) uint8, 1 where a voxel is
    before  (B, 8) int32: the brick that lies one cell back along x (4), y (2) and z (1), by the sum of these; -1 where none does
    """
    reads, state, words, table, symbol_of, shares, symbols, contexts = coder
    near = np.zeros((b + 1, b + 1, b + 1), np.uint8)
    for n in range(begin, end):
        for p in range(b + 1):
            for q in range(b + 1):
                for r in range(b + 1):
                    if p > 0 and q > 0 and r > 0:
                        near[p, q, r] = stored[n, _slot(p - 1, q - 1, r - 1, b)]
                        continue
                    brick = before[n, (p == 0) * 4 + (q == 0) * 2 + (r == 0)]
                    near[p, q, r] = 0
                    if brick >= 0:
                        near[p, q, r] = stored[brick, _slot((p - 1) % b, (q - 1) % b, (r - 1) % b, b)]
        for p in range(1, b + 1):
            for q in range(1, b + 1):
                for r in range(1, b + 1):
                    context = near[p - 1, q, r] | near[p, q - 1, r] << 1 | near[p, q, r - 1] << 2 | near[p - 1, q - 1, r] << 3
                    context |= near[p - 1, q, r - 1] << 4 | near[p, q - 1, r - 1] << 5 | near[p - 1, q - 1, r - 1] << 6
                    value = coded(reads, state, words, table, symbol_of, shares, symbols, contexts, context, near[p, q, r])
                    if value > 1:
                        state[FAILED] = 1
                    value &= 1
                    near[p, q, r] = value
                    stored[n, _slot(p - 1, q - 1, r - 1, b)] = value


@numba.njit(cache=True, error_model="numpy")
def find_neighbours(index, before, b, neighbours, begin, end):  # type: ignore[no-untyped-def]
    """Voxels one step back along x, y and z from those of bricks `begin` to `end`: neighbours (N, 3) int32, -1 where none is stored.

    index  (B, b^3) int32: numbers of the stored voxels
    """
    for n in range(begin, end):
        for p in range(b):
            for q in range(b):
                for r in range(b):
                    voxel = index[n, _slot(p, q, r, b)]
                    if voxel < 0:
                        continue
                    for axis in range(3):
                        i, j, k = p - (axis == 0), q - (axis == 1), r - (axis == 2)
                        brick = n
                        if i < 0 or j < 0 or k < 0:
                            brick = before[n, 4 >> axis]
                        neighbours[voxel, axis] = -1 if brick < 0 else index[brick, _slot(i % b, j % b, k % b, b)]


@numba.njit(cache=True, error_model="numpy")
def walk_densities(coder, codes, neighbours, entries, begin, end):  # type: ignore[no-untyped-def]
    """Codes (N,) uint8 into a table of so many entries."""
    reads, state, words, table, symbol_of, shares, symbols, contexts = coder
    for n in range(begin, end):
        total, count = 0, 0
        for axis in range(3):
            near = neighbours[n, axis]
            if near >= 0:
                total += codes[near]
                count += 1
        context = 1 + min(32 * (total // count) // entries, 31) if count else 0
        codes[n] = coded(reads, state, words, table, symbol_of, shares, symbols, contexts, context, codes[n])


@numba.njit(inline="always")
def _predicted(codes, neighbours, n, channel):  # type: ignore[no-untyped-def]
    """Mean of the neighbours' codes, and the class of how far they lie apart: 0 without neighbours, else 1 to 7."""
    total, count, least, most = np.int64(0), 0, np.int64(255), np.int64(0)
    for axis in range(3):
        near = neighbours[n, axis]
        if near >= 0:
            value = np.int64(codes[near, channel])
            total += value
            count += 1
            least, most = min(least, value), max(most, value)
    if count == 0:
        return np.int64(0), np.int64(0)
    return total // count, 1 + min(DIGITS[most - least], 6)


@numba.njit(cache=True, error_model="numpy")
def walk_bases(coder, codes, neighbours, entries, channel, begin, end):  # type: ignore[no-untyped-def]
    """Codes (N, 3) uint8 of one channel; green (1) comes first, and how far it is from its prediction corrects that of red (0) and blue (2)."""
    reads, state, words, table, symbol_of, shares, symbols, contexts = coder
    for n in range(begin, end):
        predicted, spread = _predicted(codes, neighbours, n, channel)
        context = spread
        if channel != 1:
            green, _ = _predicted(codes, neighbours, n, 1)
            difference = np.int64(codes[n, 1]) - green
            predicted = min(max(predicted + difference, 0), entries - 1)
            context = 8 + 32 * channel + 8 * spread + min(DIGITS[abs(difference)], 7)
        symbol = coded(reads, state, words, table, symbol_of, shares, symbols, contexts, context, (np.int64(codes[n, channel]) - predicted) & 255)
        codes[n, channel] = (predicted + symbol) & 255


@numba.njit(cache=True, error_model="numpy")
def walk_codes(coder, codes, neighbours, beside, shift, first, begin, end):  # type: ignore[no-untyped-def]
    """Codes (N,) of one group: whether each is that of a neighbour, and which if not.

    beside     (N,) uint8: four times how the group before was coded, 0 as a neighbour's, else 1 to 3 by its leading byte; and the quarter of the table that the
               density lies in; overwritten with what holds for this group
    shift      8 for codes of two bytes, 0 for those of one: a code's leading byte is what is left above
    first      context of the group
    """
    reads, state, words, table, symbol_of, shares, symbols, contexts = coder
    for n in range(begin, end):
        digits, count, kinds = 0, 0, 0
        known_a, known_b, known_c = np.int64(-1), np.int64(-1), np.int64(-1)
        for axis in range(3):
            near = neighbours[n, axis]
            if near < 0:
                continue
            value = np.int64(codes[near])
            digits += DIGITS[value >> shift]
            count += 1
            if kinds == 0:
                known_a, kinds = value, 1
            elif kinds == 1:
                if value != known_a:
                    known_b, kinds = value, 2
            elif value != known_a and value != known_b:
                known_c, kinds = value, 3
        situation = np.int64(beside[n])
        value = np.int64(codes[n])
        symbol = NEW
        if not reads:
            symbol = 0 if value == known_a else 1 if value == known_b else 2 if value == known_c else NEW
        agreement = count if kinds < 2 else count + 2 if kinds == 2 else 6  # 0; 1 to 3; 4 and 5; 6
        symbol = coded(reads, state, words, table, symbol_of, shares, symbols, contexts, first + 16 * agreement + situation, symbol)
        if symbol == NEW:
            context = first + REPEAT_CONTEXTS + 16 * MEAN_DIGITS[count, digits] + situation
            leading = coded(reads, state, words, table, symbol_of, shares, symbols, contexts, context, value >> shift)
            if shift:
                context = first + REPEAT_CONTEXTS + CODE_CONTEXTS + leading
                value = leading << 8 | coded(reads, state, words, table, symbol_of, shares, symbols, contexts, context, value & 255)
            else:
                value = leading
            beside[n] = 4 * (1 if leading < 8 else 2 if leading < 64 else 3) + (situation & 3)
        else:
            value = known_a if symbol == 0 else known_b if symbol == 1 else known_c
            beside[n] = situation & 3
            if symbol >= kinds:  # names no neighbour
                state[FAILED] = 1
                value = np.int64(0)
        codes[n] = value
