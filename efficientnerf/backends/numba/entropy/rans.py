"""rANS (Duda 2013) with static tables that contexts choose: the state of 32 bits is refilled by words of 16.

M symbols, T tables, n contexts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import numba

BITS = 14  # of probabilities
SLOTS = 1 << BITS
LOWEST = 1 << 16  # of the state between symbols
X, AT, FAILED = 0, 1, 2  # of `Coder.state`: the state, the next word (or record), whether words ran out


class Coder(NamedTuple):
    """One stream, read or written by the same walk.

    reads    whether symbols are read from words; else they are recorded, for `encode`
    state    (3,) int64: X, AT, FAILED
    words    (W,) uint16
    table    (n,) uint8, of each context
    symbol   (T, SLOTS) uint8: which symbol a slot stands for
    shares   (T, 256) uint32: of a symbol the number of its slots, and 2^16 times the first of them
    symbols, contexts  (M,) uint8 and uint16, recorded
    """

    reads: bool
    state: np.ndarray
    words: np.ndarray
    table: np.ndarray
    symbol: np.ndarray
    shares: np.ndarray
    symbols: np.ndarray
    contexts: np.ndarray


@numba.njit(inline="always")
def coded(reads, state, words, table, symbol, shares, symbols, contexts, context, value):  # type: ignore[no-untyped-def]
    """The next symbol of a coder, whose fields come first: read, or `value`, which is recorded.

    Inlined, and of arrays that were taken from the tuple before the loop: a call with all of them, or references that are counted, take four times as long.
    """
    if not reads:
        at = state[AT]
        symbols[at] = value
        contexts[at] = context
        state[AT] = at + 1
        return np.int64(value)
    x = state[X]
    row = np.int64(table[context])
    slot = x & (SLOTS - 1)
    found = np.int64(symbol[row, slot])
    share = np.int64(shares[row, found])
    x = (share & 0xFFFF) * (x >> BITS) + slot - (share >> 16)
    if x < LOWEST:
        at = state[AT]
        if at < words.shape[0]:
            x = (x << 16) | np.int64(words[at])
        else:
            state[FAILED] = 1
            x = LOWEST
        state[AT] = at + 1
    state[X] = x
    return found


@numba.njit(cache=True, error_model="numpy")
def fill_slots(frequency, shares, symbol):  # type: ignore[no-untyped-def]
    """`shares` and `symbol` of a coder whose frequencies (T, 256) have the sum SLOTS in each table."""
    for t in range(frequency.shape[0]):
        reached = np.int64(0)
        for s in range(256):
            count = np.int64(frequency[t, s])
            shares[t, s] = count | reached << 16
            symbol[t, reached : reached + count] = s
            reached += count


@numba.njit(cache=True, error_model="numpy")
def encode(symbols, contexts, table, shares, words, state):  # type: ignore[no-untyped-def]
    """Encode these symbols, the last first; words are written from the end of `words` towards its beginning.

    state  (2,) int64, kept between calls: the state, and the place of the last word written
    """
    x, at = state[0], state[1]
    for n in range(symbols.shape[0] - 1, -1, -1):
        t, s = table[contexts[n]], symbols[n]
        share = np.int64(shares[t, s])
        count = share & 0xFFFF
        if x >= count << (32 - BITS):
            at -= 1
            words[at] = x & 0xFFFF
            x >>= 16
        x = ((x // count) << BITS) + x % count + (share >> 16)
    state[0], state[1] = x, at


@numba.njit(cache=True, error_model="numpy")
def count_symbols(symbols, contexts, counts):  # type: ignore[no-untyped-def]
    """Add each symbol to counts (n, 256) int64 of its context."""
    for n in range(symbols.shape[0]):
        counts[contexts[n], symbols[n]] += 1


@numba.njit(inline="always")
def _cost(counts):  # type: ignore[no-untyped-def]
    """Bits of symbols of these counts (256,), and of their table."""
    total, bits = 0.0, 0.0
    for s in range(256):
        c = counts[s]
        if c > 0:
            total += c
            bits += 10.0 - c * np.log2(c)
    return bits + (total * np.log2(total) if total > 0 else 0.0)


@numba.njit(cache=True, error_model="numpy")
def _merged_cost(a, b):  # type: ignore[no-untyped-def]
    total, bits = 0.0, 0.0
    for s in range(256):
        c = a[s] + b[s]
        if c > 0:
            total += c
            bits += 10.0 - c * np.log2(c)
    return bits + (total * np.log2(total) if total > 0 else 0.0)


@numba.njit(cache=True, error_model="numpy")
def merge_contexts(counts, most):  # type: ignore[no-untyped-def]
    """Which contexts share a table: (n,) int64, the least context of each table. Pairs whose union costs least are joined until it costs more than it saves
    and at most `most` tables are left.

    counts  (n, 256) float64; overwritten
    """
    n = counts.shape[0]
    owner = np.arange(n)
    alive = np.empty(n, np.bool_)
    own = np.empty(n)
    left = 0
    for i in range(n):
        own[i] = _cost(counts[i])
        alive[i] = counts[i].sum() > 0
        left += alive[i]
    gain = np.full((n, n), np.inf)
    for i in range(n):
        if alive[i]:
            for j in range(i + 1, n):
                if alive[j]:
                    gain[i, j] = _merged_cost(counts[i], counts[j]) - own[i] - own[j]
    while left > 1:
        best, a, b = np.inf, -1, -1
        for i in range(n):
            if alive[i]:
                for j in range(i + 1, n):
                    if gain[i, j] < best:
                        best, a, b = gain[i, j], i, j
        if a < 0 or (best >= 0 and left <= most):
            break
        counts[a] += counts[b]
        own[a] = _cost(counts[a])
        alive[b] = False
        left -= 1
        for i in range(n):
            if owner[i] == b:
                owner[i] = a
            gain[min(i, b), max(i, b)] = np.inf
        for i in range(n):
            if alive[i] and i != a:
                gain[min(i, a), max(i, a)] = _merged_cost(counts[a], counts[i]) - own[a] - own[i]
    return owner
