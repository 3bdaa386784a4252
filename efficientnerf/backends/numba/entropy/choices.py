"""Codes that are cheap for what they are worth: each voxel's is the one of least distortion and bits, given those of its neighbours before it.

Contexts are those of `walks`; what a symbol of a context costs was counted in the pass before. Distortions are in bits: squared errors times a weight.

N stored voxels, P entries of a palette, D numbers of a vector, T entries of a table.
"""

from __future__ import annotations

import numpy as np

from efficientnerf.backends.numba.entropy.walks import DIGITS, MEAN_DIGITS, NEW, _predicted
from efficientnerf.backends.numba.runtime import numba


@numba.njit(inline="always")
def _error(vectors, palette, n, p):  # type: ignore[no-untyped-def]
    total = np.float32(0)
    for d in range(vectors.shape[1]):
        difference = vectors[n, d] - palette[p, d]
        total += difference * difference
    return total


@numba.njit(cache=True, error_model="numpy")
def choose_codes(vectors, weight, palette, neighbours, beside, repeat_bits, code_bits, least_bits, codes, begin, end):  # type: ignore[no-untyped-def]
    """Codes (N,) uint8 of one group. A palette is searched only where its cheapest entry, were it exact, would be better than a neighbour's.

    vectors      (N, D) float32; palette (P, D)
    weight       (N,) float32: bits that a squared error of 1 is worth
    beside       (N,) uint8, as in `walks.walk_codes`, overwritten
    repeat_bits  (112, 4) float32; code_bits (160, P), least_bits (160,) the least of each row
    """
    for n in range(begin, end):
        digits, count, kinds = 0, 0, 0
        known = (np.int64(-1), np.int64(-1), np.int64(-1))
        known_a, known_b, known_c = known
        for axis in range(3):
            near = neighbours[n, axis]
            if near < 0:
                continue
            value = np.int64(codes[near])
            digits += DIGITS[value]
            count += 1
            if kinds == 0:
                known_a, kinds = value, 1
            elif kinds == 1:
                if value != known_a:
                    known_b, kinds = value, 2
            elif value != known_a and value != known_b:
                known_c, kinds = value, 3
        situation = np.int64(beside[n])
        agreement = count if kinds < 2 else count + 2 if kinds == 2 else 6
        row, context = 16 * agreement + situation, 16 * MEAN_DIGITS[count, digits] + situation
        best, least, found = np.int64(0), np.float32(np.inf), NEW
        for symbol in range(kinds):
            value = known_a if symbol == 0 else known_b if symbol == 1 else known_c
            cost = weight[n] * _error(vectors, palette, n, value) + repeat_bits[row, symbol]
            if cost < least:
                best, least, found = value, cost, symbol
        if repeat_bits[row, NEW] + least_bits[context] < least:
            for p in range(palette.shape[0]):
                cost = weight[n] * _error(vectors, palette, n, p) + repeat_bits[row, NEW] + code_bits[context, p]
                if cost < least and p != known_a and p != known_b and p != known_c:
                    best, least, found = np.int64(p), cost, NEW
        codes[n] = best
        beside[n] = 4 * (0 if found != NEW else 1 if best < 8 else 2 if best < 64 else 3) + (situation & 3)


@numba.njit(cache=True, error_model="numpy")
def choose_bases(values, weight, table, neighbours, bits, codes, channel, begin, end):  # type: ignore[no-untyped-def]
    """Codes (N, 3) uint8 of one channel, of those between the nearest one, which is there before, and the one that is foretold.

    values  (N, 3) float32; weight (N, 3); table (T, 3)
    bits    (136, 256) float32
    """
    entries = np.int64(table.shape[0])
    for n in range(begin, end):
        predicted, spread = _predicted(codes, neighbours, n, channel)
        context = spread
        if channel != 1:
            green, _ = _predicted(codes, neighbours, n, 1)
            difference = np.int64(codes[n, 1]) - green
            predicted = min(max(predicted + difference, 0), entries - 1)
            context = 8 + 32 * channel + 8 * spread + min(DIGITS[abs(difference)], 7)
        nearest = np.int64(codes[n, channel])
        best, least = nearest, np.float32(np.inf)
        for code in range(min(nearest, predicted), max(nearest, predicted) + 1):
            difference = values[n, channel] - table[code, channel]
            cost = weight[n, channel] * difference * difference + bits[context, (code - predicted) & 255]
            if cost < least:
                best, least = np.int64(code), cost
        codes[n, channel] = best


@numba.njit(cache=True, error_model="numpy")
def choose_densities(opacity, weight, table, neighbours, bits, codes, begin, end):  # type: ignore[no-untyped-def]
    """Codes (N,) uint8.

    opacity  (N,) float32 of the voxels; table (T,) float32 of the entries
    bits     (33, T) float32
    """
    entries = table.shape[0]
    for n in range(begin, end):
        total, count = 0, 0
        for axis in range(3):
            near = neighbours[n, axis]
            if near >= 0:
                total += codes[near]
                count += 1
        context = 1 + min(32 * (total // count) // entries, 31) if count else 0
        best, least = 0, np.float32(np.inf)
        for code in range(entries):
            difference = opacity[n] - table[code]
            cost = weight[n] * difference * difference + bits[context, code]
            if cost < least:
                best, least = code, cost
        codes[n] = best
