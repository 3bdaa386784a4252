"""rANS (Duda 2013) with static tables that contexts choose: states of 32 bits are refilled by words of 16.

A stream is cut into slices that know nothing of each other, so that cores decode them at the same time. In a slice several states, the lanes, take words in
turn (Giesen 2014): while one waits for its table the next ones go on. Nothing branches on what is decoded.

M symbols, T tables, n contexts, S slices, L lanes.
"""

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.vector import emit
from efficientnerf.backends.numba.vector.memory import advanced, pointer, pointers

BITS = 14  # of probabilities
SLOTS = 1 << BITS
LOWEST = 1 << 16  # of a state between symbols


class Coder(NamedTuple):
    """One stream, read or written by the same walk."""

    reads: bool  # whether symbols are read from words; else they are recorded, for `encode`
    state: np.ndarray  # (S, L) int64
    # at, end: (S,) int64: the next word of each slice and the end of its words; the next record and the first
    at: np.ndarray
    end: np.ndarray
    failed: np.ndarray  # (S,) int64: not 0 where words ran out, or a symbol stood for nothing
    words: np.ndarray  # (W + 1,) uint16, of which the last is none
    table: np.ndarray  # (n,) uint8, of each context
    symbol: np.ndarray  # (T, SLOTS) uint8: which symbol a slot stands for
    shares: np.ndarray  # (T, 256) uint32: of a symbol the number of its slots, and 2^16 times the first of them
    # symbols, contexts: (M,) uint8 and uint16, recorded
    symbols: np.ndarray
    contexts: np.ndarray


class Slice(NamedTuple):
    """One slice of a coder: this with pointers, which no reference count slows down, the end of the slice's words, and its states."""

    coder: Coder
    end: int
    state: Any


@intrinsic
def digits(typing_context: Any, value: Any) -> Any:
    """Number of binary digits of an int64 that is not negative."""
    count = emit.emits(lambda builder, value: builder.sub(emit.index(64), builder.ctlz(value, ir.Constant(emit.I1, 0))))
    return types.int64(types.int64), count


@numba.njit(inline="always")
def slice_of(coder, s):
    return Slice(pointers(coder), coder.end[s], advanced(pointer(coder.state), s * coder.state.shape[1]))


@numba.njit(inline="always")
def _refilled(one, lane, x, at):
    """Keep the state of a lane, with a word more if it is low: where the next word is, and 1 if there was none."""
    low = np.int64(x < LOWEST)
    there = low & np.int64(at < one.end)
    word = np.int64(one.coder.words[at])
    one.state[lane] = (x << (low << 4)) | (word & -low)
    return at + there, low ^ there


@numba.njit(inline="always")
def coded(one, lane, context, value, at, few):
    """The next symbol of a slice, read, or `value`, which is recorded; where it goes on; and 1 if words ran out.

    lane  whose state it is; the same for all symbols of a context
    at    where the slice is
    few   2 or 4, if the tables of the context have no more symbols: what slots stand for is not looked up then; else 0
    """
    coder = one.coder
    if not coder.reads:
        coder.symbols[at] = value
        coder.contexts[at] = context
        return np.int64(value), at + 1, np.int64(0)
    table = np.int64(coder.table[context])
    row, x = table << 8, one.state[lane]
    slot = x & (SLOTS - 1)
    if few == 0:
        found = np.int64(coder.symbol[(table << BITS) + slot])
    else:
        found = np.int64(slot >= np.int64(coder.shares[row + 1]) >> 16)
        if few == 4:
            found += np.int64(slot >= np.int64(coder.shares[row + 2]) >> 16) + np.int64(slot >= np.int64(coder.shares[row + 3]) >> 16)
    share = np.int64(coder.shares[row + found])
    at, lacking = _refilled(one, lane, (share & 0xFFFF) * (x >> BITS) + slot - (share >> 16), at)
    return found, at, lacking


@numba.njit(cache=True, error_model="numpy")
def fill_slots(frequency, shares, symbol):
    """`shares` and `symbol` of a coder whose frequencies (T, 256) have the sum SLOTS in each table."""
    for t in range(frequency.shape[0]):
        reached = np.int64(0)
        for s in range(256):
            count = np.int64(frequency[t, s])
            shares[t, s] = count | reached << 16
            symbol[t, reached : reached + count] = s
            reached += count


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def encode(symbols, contexts, lanes, table, shares, words, begin, end, at, state, done, most):
    """Encode `most` symbols of each slice that are left, the last first, after `done` before; words are written from the end towards the beginning.

    lanes       (n,) uint8, of each context
    begin, end  (S,) int64: symbols of the slices
    at          (S,) int64, kept between calls: the place of the last word written
    state       (S, L) int64, kept too
    """
    for s in numba.prange(len(begin)):
        place = at[s]
        for m in range(max(begin[s], end[s] - done), max(begin[s], end[s] - done - most), -1):
            c = contexts[m - 1]
            share = np.int64(shares[table[c], symbols[m - 1]])
            lane, count = lanes[c], share & 0xFFFF
            x = state[s, lane]
            if x >= count << (32 - BITS):
                place -= 1
                words[place] = x & 0xFFFF
                x >>= 16
            state[s, lane] = ((x // count) << BITS) + x % count + (share >> 16)
        at[s] = place


@numba.njit(cache=True, error_model="numpy")
def count_symbols(symbols, contexts, counts):
    """Add each symbol to counts (n, 256) int64 of its context."""
    for n in range(symbols.shape[0]):
        counts[contexts[n], symbols[n]] += 1


@numba.njit(inline="always")
def _cost(counts):
    """Bits of symbols of these counts (256,), and of their table."""
    total, bits = 0.0, 0.0
    for s in range(256):
        c = counts[s]
        if c > 0:
            total += c
            bits += 10.0 - c * np.log2(c)
    return bits + (total * np.log2(total) if total > 0 else 0.0)


@numba.njit(cache=True, error_model="numpy")
def merge_contexts(counts, most):
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
                    gain[i, j] = _cost(counts[i] + counts[j]) - own[i] - own[j]
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
                gain[min(i, a), max(i, a)] = _cost(counts[a] + counts[i]) - own[a] - own[i]
    return owner
