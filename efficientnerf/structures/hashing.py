"""Sparse tensor: a hash map from coordinates to values.

Open addressing with linear probing over 64-bit keys, murmur3's finaliser as the hash and at most half of the slots in use, as in
MinkowskiEngine (concurrent_unordered_map, hashtable_occupancy 50) and spconv (tensorview's LinearHashTable). Those keep the number of a row of the
feature matrix beside the key; here the four values themselves lie there, being no longer than the number and what aligns it, which
saves the second access to memory.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.structures.voxels import Voxels
from efficientnerf.structures.words import CHUNK, ONE, TASK, ZERO, compare_and_swap, fill, whole, within

LOAD = 0.5  # most of the slots that are in use
EMPTY = np.uint64(0xFFFFFFFFFFFFFFFF)  # no key: keys have 63 bits


@numba.njit(cache=True, inline="always")
def _key(x, y, z):  # type: ignore[no-untyped-def]
    """21 bits for each coordinate."""
    return (x << np.uint64(42)) | (y << np.uint64(21)) | z


@numba.njit(cache=True, inline="always")
def _home(key, slots):  # type: ignore[no-untyped-def]
    """The slot where the search for a key begins: murmur3's 64-bit finaliser, its upper half scaled to the table."""
    key ^= key >> np.uint64(33)
    key *= np.uint64(0xFF51AFD7ED558CCD)
    key ^= key >> np.uint64(33)
    key *= np.uint64(0xC4CEB9FE1A85EC53)
    key ^= key >> np.uint64(33)
    return ((key >> np.uint64(32)) * slots) >> np.uint64(32)


@numba.njit(cache=True, inline="always")
def _next(slot, slots):  # type: ignore[no-untyped-def]
    return slot + ONE if slot + ONE < slots else ZERO


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _store(coordinates, words, slots, table):  # type: ignore[no-untyped-def]
    n = len(coordinates)
    for task in numba.prange((n + TASK - 1) // TASK):
        key, slot, seen = np.empty(CHUNK, np.uint64), np.empty(CHUNK, np.uint64), ZERO
        for begin in range(task * TASK, min(n, (task + 1) * TASK), CHUNK):
            end = min(begin + CHUNK, n)
            many, voxel, word = np.uint64(end - begin), coordinates[begin:end], words[begin:end]
            for i in range(many):
                key[i] = _key(whole(voxel[i, 0]), whole(voxel[i, 1]), whole(voxel[i, 2]))
                slot[i] = _home(key[i], slots)
            for i in range(many):
                seen |= table[slot[i] << ONE]  # brings the slots near, all at once: an atomic operation would wait for each
            for i in range(many):
                at = slot[i]
                while table[at << ONE] != EMPTY or compare_and_swap(table, at << ONE, EMPTY, key[i]) != EMPTY:
                    at = _next(at, slots)
                table[(at << ONE) | ONE] = word[i]
        if seen == ZERO:  # never, for an empty slot has all bits; but the compiler cannot know, and keeps the loop above
            table[0] = seen


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _look_up(points, side, slots, table, words, found):  # type: ignore[no-untyped-def]
    """Probe by probe for a chunk of points: those that find their key or an empty slot are left out of the probes after."""
    n, top = len(points), np.float32(side)
    for task in numba.prange((n + TASK - 1) // TASK):
        key, slot, held = np.empty(CHUNK, np.uint64), np.empty(CHUNK, np.uint64), np.empty(CHUNK, np.uint64)
        active, still = np.empty(CHUNK, np.uint64), np.empty(CHUNK, np.uint64)
        for begin in range(task * TASK, min(n, (task + 1) * TASK), CHUNK):
            end = min(begin + CHUNK, n)
            point, out, there = points[begin:end], words[begin:end], found[begin:end]
            many = np.uint64(end - begin)
            for i in range(many):
                x, y, z = point[i, 0], point[i, 1], point[i, 2]
                key[i] = _key(whole(x), whole(y), whole(z)) if within(x, y, z, top) else EMPTY
                slot[i] = _home(key[i], slots) << ONE
            for i in range(many):
                held[i] = table[slot[i]]
            count = ZERO
            for i in range(many):
                active[count] = i
                count += np.uint64((held[i] != key[i]) & (held[i] != EMPTY))
            while count != ZERO:
                for a in range(count):
                    i = active[a]
                    slot[i] = _next(slot[i] >> ONE, slots) << ONE
                    held[i] = table[slot[i]]
                left = ZERO
                for a in range(count):
                    i = active[a]
                    still[left] = i
                    left += np.uint64((held[i] != key[i]) & (held[i] != EMPTY))
                active, still, count = still, active, left
            for i in range(many):
                hit = held[i] != EMPTY
                out[i] = table[slot[i] | ONE] & (ZERO - np.uint64(hit))
                there[i] = hit


@dataclass(frozen=True, eq=False)
class HashMap:
    """side voxels along each side of the grid; table (2 slots,) uint64: key and word of each slot."""

    side: int
    slots: int
    table: np.ndarray

    @staticmethod
    def cache(voxels: Voxels) -> HashMap:
        slots = max(int(np.ceil(len(voxels.words) / LOAD)), 1)
        table = np.empty(2 * slots, np.uint64)
        fill(table, EMPTY)
        _store(voxels.coordinates, voxels.words, np.uint64(slots), table)
        return HashMap(voxels.side, slots, table)

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        return {"table": self.table}

    def query(self, points: np.ndarray, words: np.ndarray, found: np.ndarray) -> None:
        """See `efficientnerf.structures.dense.DenseVoxels.query`."""
        _look_up(points, self.side, np.uint64(self.slots), self.table, words, found)
