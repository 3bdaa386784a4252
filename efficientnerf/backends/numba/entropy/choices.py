"""Codes that are cheap for what they are worth: each voxel's is the one of least distortion and bits, given those of its neighbours before it.

Slices know nothing of each other, so that all cores choose; `first` (S + 1,) int64 says which voxel each begins with, and N.
Contexts are those of `walks`; what a symbol of a context costs was counted in the pass before. Distortions are in bits: squared errors times a weight.

N stored voxels, P entries of a palette, D numbers of a vector, T entries of a table.
"""

import numpy as np

from efficientnerf.backends.numba.entropy.walks import NEW, REPEAT_CONTEXTS, base_prediction, density_context, known_codes, near_voxels, newness
from efficientnerf.backends.numba.runtime import PRANGE, numba


@numba.njit(cache=True, error_model="numpy")
def count_codes(codes, neighbours, beside, counts, begin, end):
    """Add the symbols of one group's codes (N,) uint8 to counts (272, 256) int64 of their contexts; `beside` as in `choose_codes`."""
    for n in range(begin, end):
        count, p, q, r = near_voxels(neighbours, n)
        a, b, c, value = np.int64(codes[p]), np.int64(codes[q]), np.int64(codes[r]), np.int64(codes[n])
        kinds, second, agreement, length = known_codes(count, a, b, c, 0)
        symbol = NEW if kinds == 0 else 0 if value == a else 1 if value == second and kinds > 1 else 2 if value == c and kinds > 2 else NEW
        situation = np.int64(beside[n])
        counts[16 * agreement + situation, symbol] += 1
        if symbol == NEW:
            counts[REPEAT_CONTEXTS + 16 * length + situation, value] += 1
        beside[n] = 4 * (newness(value) if symbol == NEW else 0) + (situation & 3)


@numba.njit(inline="always")
def _error(vectors, palette, n, p):
    total = np.float32(0)
    for d in range(vectors.shape[1]):
        difference = vectors[n, d] - palette[p, d]
        total += difference * difference
    return total


@numba.njit
def _choose_codes(vectors, weight, palette, neighbours, beside, repeat_bits, code_bits, least_bits, codes, begin, end):
    for n in range(begin, end):
        count, p, q, r = near_voxels(neighbours, n)
        known_a, known_c = np.int64(codes[p]), np.int64(codes[r])
        kinds, known_b, agreement, length = known_codes(count, known_a, np.int64(codes[q]), known_c, 0)
        situation = np.int64(beside[n])
        row, context = 16 * agreement + situation, 16 * length + situation
        best, least, found = np.int64(0), np.float32(np.inf), NEW
        for symbol in range(kinds):
            value = known_a if symbol == 0 else known_b if symbol == 1 else known_c
            cost = weight[n] * _error(vectors, palette, n, value) + repeat_bits[row, symbol]
            if cost < least:
                best, least, found = value, cost, symbol
        if repeat_bits[row, NEW] + least_bits[context] < least:
            for p in range(palette.shape[0]):
                cost = weight[n] * _error(vectors, palette, n, p) + repeat_bits[row, NEW] + code_bits[context, p]
                if cost < least and not ((kinds > 0 and p == known_a) or (kinds > 1 and p == known_b) or (kinds > 2 and p == known_c)):
                    best, least, found = np.int64(p), cost, NEW
        codes[n] = best
        beside[n] = 4 * (newness(best) if found == NEW else 0) + (situation & 3)


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def choose_codes(vectors, weight, palette, neighbours, beside, repeat_bits, code_bits, least_bits, codes, first, begin, end):
    """Codes (N,) uint8 of one group. A palette is searched only where its cheapest entry, were it exact, would be better than a neighbour's.

    vectors      (N, D) float32; palette (P, D)
    weight       (N,) float32: bits that a squared error of 1 is worth
    neighbours   (3 N,) int32
    beside       (N,) uint8: four times how the group before was coded, 0 as a neighbour's, else `newness`; and the quarter of the table that the density
                 lies in; overwritten with what holds for this group
    repeat_bits  (112, 4) float32; code_bits (160, P), least_bits (160,) the least of each row
    """
    for s in numba.prange(len(first) - 1):
        least, most = min(first[s] + begin, first[s + 1]), min(first[s] + end, first[s + 1])
        _choose_codes(vectors, weight, palette, neighbours, beside, repeat_bits, code_bits, least_bits, codes, least, most)


@numba.njit
def _choose_bases(values, weight, table, neighbours, bits, codes, channel, begin, end):
    for n in range(begin, end):
        predicted, context = base_prediction(codes, neighbours, np.int64(table.shape[0]), n, channel)
        nearest = np.int64(codes[3 * n + channel])
        best, least = nearest, np.float32(np.inf)
        for code in range(min(nearest, predicted), max(nearest, predicted) + 1):
            difference = values[n, channel] - table[code, channel]
            cost = weight[n, channel] * difference * difference + bits[context, (code - predicted) & 255]
            if cost < least:
                best, least = np.int64(code), cost
        codes[3 * n + channel] = best


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def choose_bases(values, weight, table, neighbours, bits, codes, channel, first, begin, end):
    """Codes (3 N,) uint8 of one channel, of those between the nearest one, which is there before, and the one that is predicted.

    values  (N, 3) float32; weight (N, 3); table (T, 3)
    bits    (136, 256) float32
    """
    for s in numba.prange(len(first) - 1):
        _choose_bases(values, weight, table, neighbours, bits, codes, channel, min(first[s] + begin, first[s + 1]), min(first[s] + end, first[s + 1]))


@numba.njit
def _choose_densities(opacity, weight, table, neighbours, bits, codes, begin, end):
    entries = table.shape[0]
    for n in range(begin, end):
        context = density_context(codes, neighbours, n, entries)
        best, least = 0, np.float32(np.inf)
        for code in range(entries):
            difference = opacity[n] - table[code]
            cost = weight[n] * difference * difference + bits[context, code]
            if cost < least:
                best, least = code, cost
        codes[n] = best


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def choose_densities(opacity, weight, table, neighbours, bits, codes, first, begin, end):
    """Codes (N,) uint8.

    opacity  (N,) float32 of the voxels; table (T,) float32 of the entries
    bits     (33, T) float32
    """
    for s in numba.prange(len(first) - 1):
        _choose_densities(opacity, weight, table, neighbours, bits, codes, min(first[s] + begin, first[s + 1]), min(first[s] + end, first[s + 1]))
