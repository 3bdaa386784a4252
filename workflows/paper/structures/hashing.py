"""Sparse tensor: a hash map from coordinates to values.

Open addressing with linear probing over 64-bit keys, murmur3's finaliser as the hash, and a load factor of at most one half, as in MinkowskiEngine
(concurrent_unordered_map, hashtable_occupancy 50) and spconv (tensorview's LinearHashTable). Those keep the row of the feature matrix next to the key; here the
four values are stored there, which take as much space as the row and its alignment, and save the second memory access.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from workflows.paper.structures.bits import CHUNK, ONE, TASK, ZERO, compare_and_swap, fill, floor_to_uint64, in_grid
from workflows.paper.structures.voxels import Voxels

LOAD_FACTOR = 0.5  # at most
EMPTY = np.uint64(0xFFFFFFFFFFFFFFFF)  # not a key: keys have 63 bits


@numba.njit(cache=True, inline="always")
def _key(x, y, z):  # type: ignore[no-untyped-def]
    """21 bits for each coordinate."""
    return (x << np.uint64(42)) | (y << np.uint64(21)) | z


@numba.njit(cache=True, inline="always")
def _home(key, slots):  # type: ignore[no-untyped-def]
    """First slot of a key's probe sequence: murmur3's 64-bit finaliser, its upper half scaled to the table."""
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
def _store(coordinates, packed, slots, table):  # type: ignore[no-untyped-def]
    n = len(coordinates)
    for task in numba.prange((n + TASK - 1) // TASK):
        key, slot, union = np.empty(CHUNK, np.uint64), np.empty(CHUNK, np.uint64), ZERO
        for begin in range(task * TASK, min(n, (task + 1) * TASK), CHUNK):
            end = min(begin + CHUNK, n)
            size, voxel, word = np.uint64(end - begin), coordinates[begin:end], packed[begin:end]
            for i in range(size):
                key[i] = _key(floor_to_uint64(voxel[i, 0]), floor_to_uint64(voxel[i, 1]), floor_to_uint64(voxel[i, 2]))
                slot[i] = _home(key[i], slots)
            for i in range(size):
                union |= table[slot[i] << ONE]  # prefetches the slots; atomic operations would miss one after the other
            for i in range(size):
                at = slot[i]
                while table[at << ONE] != EMPTY or compare_and_swap(table, at << ONE, EMPTY, key[i]) != EMPTY:
                    at = _next(at, slots)
                table[(at << ONE) | ONE] = word[i]
        if union == ZERO:  # never true, since empty slots have all bits set; keeps the compiler from removing the loads
            table[0] = union


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _query(points, side, slots, table, packed, occupied):  # type: ignore[no-untyped-def]
    """Probes a chunk of points in lockstep; points that find their key or an empty slot drop out."""
    n, top = len(points), np.float32(side)
    for task in numba.prange((n + TASK - 1) // TASK):
        key, slot, held = np.empty(CHUNK, np.uint64), np.empty(CHUNK, np.uint64), np.empty(CHUNK, np.uint64)
        active, still = np.empty(CHUNK, np.uint64), np.empty(CHUNK, np.uint64)
        for begin in range(task * TASK, min(n, (task + 1) * TASK), CHUNK):
            end = min(begin + CHUNK, n)
            point, out, there = points[begin:end], packed[begin:end], occupied[begin:end]
            size = np.uint64(end - begin)
            for i in range(size):
                x, y, z = point[i, 0], point[i, 1], point[i, 2]
                key[i] = _key(floor_to_uint64(x), floor_to_uint64(y), floor_to_uint64(z)) if in_grid(x, y, z, top) else EMPTY
                slot[i] = _home(key[i], slots) << ONE
            for i in range(size):
                held[i] = table[slot[i]]
            count = ZERO
            for i in range(size):
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
            for i in range(size):
                hit = held[i] != EMPTY
                out[i] = table[slot[i] | ONE] & (ZERO - np.uint64(hit))
                there[i] = hit


@dataclass(frozen=True, eq=False)
class HashMap:
    """side voxels along each side of the grid; table (2 slots,) uint64: key and packed value of each slot."""

    side: int
    slots: int
    table: np.ndarray

    @staticmethod
    def cache(voxels: Voxels) -> HashMap:
        slots = max(int(np.ceil(len(voxels.packed) / LOAD_FACTOR)), 1)
        table = np.empty(2 * slots, np.uint64)
        fill(table, EMPTY)
        _store(voxels.coordinates, voxels.packed, np.uint64(slots), table)
        return HashMap(voxels.side, slots, table)

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        return {"table": self.table}

    def query(self, points: np.ndarray, packed: np.ndarray, occupied: np.ndarray) -> None:
        """See `workflows.paper.structures.dense.DenseVoxels.query`."""
        _query(points, self.side, np.uint64(self.slots), self.table, packed, occupied)
