"""NerfTree: coarse dense voxels over sparse bricks of 4^3 voxels (EfficientNeRF, section 3.5).

BrickTree stores occupied voxels only, located by 64-bit masks (x slowest), each next to the index of its first set bit: records of 16 bytes, which do not
straddle cache lines. The coarse level is one bit per coarse cell, in a record for each block of 4^3 cells; an occupied cell has a record of its 64 voxels.
A query reads the record of a block (1/256 byte per voxel: it stays in the cache) and ends there if the cell is empty, reads the cell's record and ends there if
the voxel is empty, and reads the value.

FullBricks is the layout that the paper prints: an index for each coarse cell, and bricks of 64 values, occupied or not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from workflows.paper.structures.bits import CHUNK, ONE, TASK, ZERO, assign_ranks, atomic_or, fill, floor_to_uint64, in_grid, popcount, rank
from workflows.paper.structures.voxels import Voxels

TWO, THREE, FOUR, SIX = np.uint64(2), np.uint64(3), np.uint64(4), np.uint64(6)
NONE = np.uint64(0xFFFFFFFFFFFFFFFF)


@numba.njit(cache=True, inline="always")
def _flat_index(x, y, z, side):  # type: ignore[no-untyped-def]
    return (x * side + y) * side + z


@numba.njit(cache=True, inline="always")
def _local_index(x, y, z):  # type: ignore[no-untyped-def]
    """Index among 4^3 of a voxel in its cell, or of a cell in its block."""
    return ((x & THREE) << FOUR) | ((y & THREE) << TWO) | (z & THREE)


@numba.njit(cache=True, inline="always")
def _cell(x, y, z, side):  # type: ignore[no-untyped-def]
    """Index of the coarse cell of voxel (x, y, z), block by block."""
    block = _flat_index(x >> FOUR, y >> FOUR, z >> FOUR, side)
    return (block << SIX) | _local_index(x >> TWO, y >> TWO, z >> TWO)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _mark(coordinates, side, masks):  # type: ignore[no-untyped-def]
    """Sets the bits of occupied voxels, with one atomic operation for a run of the list in one cell."""
    n = len(coordinates)
    for task in numba.prange((n + TASK - 1) // TASK):
        current, mask = NONE, ZERO
        for i in range(task * TASK, min(n, (task + 1) * TASK)):
            x, y, z = floor_to_uint64(coordinates[i, 0]), floor_to_uint64(coordinates[i, 1]), floor_to_uint64(coordinates[i, 2])
            cell = _cell(x, y, z, side)
            if cell != current:
                if current != NONE:
                    atomic_or(masks, current, mask)
                current, mask = cell, ZERO
            mask |= ONE << _local_index(x, y, z)
        atomic_or(masks, current, mask)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _mark_blocks(masks, blocks):  # type: ignore[no-untyped-def]
    for block in numba.prange(len(blocks) // 2):
        occupied = ZERO
        for cell in range(64):
            occupied |= np.uint64(masks[64 * block + cell] != ZERO) << np.uint64(cell)
        blocks[2 * block] = occupied


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _pack_masks(masks, blocks, cells):  # type: ignore[no-untyped-def]
    """Copies the masks of occupied cells to their records."""
    for block in numba.prange(len(blocks) // 2):
        record = blocks[2 * block + 1] << ONE
        if blocks[2 * block] != ZERO:
            for cell in range(64):
                if masks[64 * block + cell] != ZERO:
                    cells[record] = masks[64 * block + cell]
                    record += TWO


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _store(coordinates, packed, side, blocks, cells, values):  # type: ignore[no-untyped-def]
    n = len(coordinates)
    for task in numba.prange((n + TASK - 1) // TASK):
        current, mask, first = NONE, ZERO, ZERO
        for i in range(task * TASK, min(n, (task + 1) * TASK)):
            x, y, z = floor_to_uint64(coordinates[i, 0]), floor_to_uint64(coordinates[i, 1]), floor_to_uint64(coordinates[i, 2])
            cell = _cell(x, y, z, side)
            if cell != current:
                block = (cell >> SIX) << ONE
                record = (blocks[block | ONE] + rank(blocks[block], cell & np.uint64(63))) << ONE
                current, mask, first = cell, cells[record], cells[record | ONE]
            values[first + rank(mask, _local_index(x, y, z))] = packed[i]


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _store_scattered(coordinates, packed, side, blocks, cells, values):  # type: ignore[no-untyped-def]
    """`_store` for lists whose neighbours seldom share a cell: the steps of a chunk are interleaved, without branches, so that cache misses overlap."""
    n = len(coordinates)
    for task in numba.prange((n + TASK - 1) // TASK):
        record, local = np.empty(CHUNK, np.uint64), np.empty(CHUNK, np.uint64)
        for begin in range(task * TASK, min(n, (task + 1) * TASK), CHUNK):
            end = min(begin + CHUNK, n)
            voxel, word, size = coordinates[begin:end], packed[begin:end], np.uint64(end - begin)
            for i in range(size):
                x, y, z = floor_to_uint64(voxel[i, 0]), floor_to_uint64(voxel[i, 1]), floor_to_uint64(voxel[i, 2])
                record[i], local[i] = _cell(x, y, z, side), _local_index(x, y, z)
            for i in range(size):
                block = (record[i] >> SIX) << ONE
                record[i] = (blocks[block | ONE] + rank(blocks[block], record[i] & np.uint64(63))) << ONE
            for i in range(size):
                values[cells[record[i] | ONE] + rank(cells[record[i]], local[i])] = word[i]


def _is_scattered(coordinates: np.ndarray) -> bool:
    """Whether most neighbours in the list lie in different cells, from a sample."""
    at = np.linspace(0, max(len(coordinates) - 2, 0), 1024).astype(np.int64)
    return len(coordinates) > 1 and bool(((coordinates[at] >> 2) != (coordinates[at + 1] >> 2)).any(axis=1).mean() > 0.5)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _query(points, grid_side, side, blocks, cells, values, packed, occupied):  # type: ignore[no-untyped-def]
    """Steps of a chunk of points are interleaved; points that end early drop out, without unpredictable branches."""
    n, top = len(points), np.float32(grid_side)
    for task in numba.prange((n + TASK - 1) // TASK):
        block, in_block, in_cell, word = np.empty(CHUNK, np.uint64), np.empty(CHUNK, np.uint64), np.empty(CHUNK, np.uint64), np.empty(CHUNK, np.uint64)
        record, whose = np.empty(CHUNK, np.uint64), np.empty(CHUNK, np.uint64)
        value, owner = np.empty(CHUNK, np.uint64), np.empty(CHUNK, np.uint64)
        for begin in range(task * TASK, min(n, (task + 1) * TASK), CHUNK):
            end = min(begin + CHUNK, n)
            point, out, there = points[begin:end], packed[begin:end], occupied[begin:end]
            size = np.uint64(end - begin)
            for i in range(size):
                x, y, z = floor_to_uint64(point[i, 0]), floor_to_uint64(point[i, 1]), floor_to_uint64(point[i, 2])
                inside = in_grid(point[i, 0], point[i, 1], point[i, 2], top)
                block[i] = _flat_index(x >> FOUR, y >> FOUR, z >> FOUR, side) << ONE if inside else ZERO
                in_block[i] = ONE << _local_index(x >> TWO, y >> TWO, z >> TWO) if inside else ZERO
                in_cell[i] = ONE << _local_index(x, y, z)
                word[i] = ZERO
            count = ZERO
            for i in range(size):
                mask, bit = blocks[block[i]], in_block[i]
                record[count] = (blocks[block[i] | ONE] + popcount(mask & (bit - ONE))) << ONE
                whose[count] = i
                count += np.uint64((mask & bit) != ZERO)
            hits = ZERO
            for a in range(count):
                i, at = whose[a], record[a]
                mask, bit = cells[at], in_cell[i]
                value[hits] = cells[at | ONE] + popcount(mask & (bit - ONE))
                owner[hits] = i
                hits += np.uint64((mask & bit) != ZERO)
            for a in range(hits):
                word[owner[a]] = values[value[a]]
            for i in range(size):
                out[i] = word[i]
                there[i] = word[i] != ZERO


@dataclass(frozen=True, eq=False)
class BrickTree:
    """NerfTree with packed bricks.

    side    voxels along each side of the grid
    blocks  (2 ceil(side / 16)^3,) uint64: mask of a block's 4^3 coarse cells, and the index of the first occupied one; x slowest
    cells   (2 B,) uint64, of each occupied cell: mask of its 4^3 voxels, and the index of the first occupied one
    values  (N,) uint64, in the order of the cells
    """

    side: int
    blocks: np.ndarray
    cells: np.ndarray
    values: np.ndarray

    @staticmethod
    def cache(voxels: Voxels) -> BrickTree:
        side = np.uint64(-(-voxels.side // 16))
        masks, blocks = np.empty(64 * int(side) ** 3, np.uint64), np.empty(2 * int(side) ** 3, np.uint64)
        fill(masks, ZERO)
        if len(voxels.packed):
            _mark(voxels.coordinates, side, masks)
        _mark_blocks(masks, blocks)
        cells = np.empty(2 * int(assign_ranks(blocks, ZERO)), np.uint64)
        _pack_masks(masks, blocks, cells)
        values = np.empty(int(assign_ranks(cells, ZERO)), np.uint64)
        store = _store_scattered if _is_scattered(voxels.coordinates) else _store
        store(voxels.coordinates, voxels.packed, side, blocks, cells, values)
        return BrickTree(voxels.side, blocks, cells, values)

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        return {"blocks": self.blocks, "cells": self.cells, "values": self.values}

    def query(self, points: np.ndarray, packed: np.ndarray, occupied: np.ndarray) -> None:
        """See `workflows.paper.structures.dense.DenseVoxels.query`."""
        _query(points, self.side, np.uint64(-(-self.side // 16)), self.blocks, self.cells, self.values, packed, occupied)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _mark_full(coordinates, side, index):  # type: ignore[no-untyped-def]
    n = len(coordinates)
    for task in numba.prange((n + TASK - 1) // TASK):
        for i in range(task * TASK, min(n, (task + 1) * TASK)):
            x, y, z = floor_to_uint64(coordinates[i, 0]) >> TWO, floor_to_uint64(coordinates[i, 1]) >> TWO, floor_to_uint64(coordinates[i, 2]) >> TWO
            index[_flat_index(x, y, z, side)] = np.uint32(1)  # a benign race: all threads write the same


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _number_full(index):  # type: ignore[no-untyped-def]
    """Numbers the marked cells from 1, in order; returns their count."""
    tasks = (len(index) + TASK - 1) // TASK
    begins = np.zeros(tasks + 1, np.int64)
    for task in numba.prange(tasks):
        begins[task + 1] = np.count_nonzero(index[task * TASK : (task + 1) * TASK])
    for task in range(tasks):
        begins[task + 1] += begins[task]
    for task in numba.prange(tasks):
        at = begins[task]
        for cell in range(task * TASK, min(len(index), (task + 1) * TASK)):
            if index[cell]:
                at += 1
                index[cell] = np.uint32(at)
    return begins[tasks]


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _store_full(coordinates, packed, side, index, bricks):  # type: ignore[no-untyped-def]
    n = len(coordinates)
    for task in numba.prange((n + TASK - 1) // TASK):
        for i in range(task * TASK, min(n, (task + 1) * TASK)):
            x, y, z = floor_to_uint64(coordinates[i, 0]), floor_to_uint64(coordinates[i, 1]), floor_to_uint64(coordinates[i, 2])
            brick = np.uint64(index[_flat_index(x >> TWO, y >> TWO, z >> TWO, side)])
            bricks[(brick << SIX) | _local_index(x, y, z)] = packed[i]


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _query_full(points, grid_side, side, index, bricks, packed, occupied):  # type: ignore[no-untyped-def]
    n, top = len(points), np.float32(grid_side)
    for task in numba.prange((n + TASK - 1) // TASK):
        where, local = np.empty(CHUNK, np.uint64), np.empty(CHUNK, np.uint64)
        for begin in range(task * TASK, min(n, (task + 1) * TASK), CHUNK):
            end = min(begin + CHUNK, n)
            point, out, there = points[begin:end], packed[begin:end], occupied[begin:end]
            size = np.uint64(end - begin)
            outside = np.uint64(len(index) - 1)
            for i in range(size):
                x, y, z = floor_to_uint64(point[i, 0]), floor_to_uint64(point[i, 1]), floor_to_uint64(point[i, 2])
                inside = in_grid(point[i, 0], point[i, 1], point[i, 2], top)
                where[i] = _flat_index(x >> TWO, y >> TWO, z >> TWO, side) if inside else outside
                local[i] = _local_index(x, y, z)
            for i in range(size):
                where[i] = (np.uint64(index[where[i]]) << SIX) | local[i]
            for i in range(size):
                out[i] = bricks[where[i]]
                there[i] = out[i] != ZERO


@dataclass(frozen=True, eq=False)
class FullBricks:
    """NerfTree as printed in the paper.

    side    voxels along each side of the grid
    index   (ceil(side / 4)^3 + 1,) uint32: brick of each coarse cell, x slowest; 0 where it is empty, and in the last entry, for points outside
    bricks  (64 (1 + B),) uint64: brick 0 is all zeros
    """

    side: int
    index: np.ndarray
    bricks: np.ndarray

    @staticmethod
    def cache(voxels: Voxels) -> FullBricks:
        side = np.uint64(-(-voxels.side // 4))
        index = np.empty(int(side) ** 3 + 1, np.uint32)
        fill(index, np.uint32(0))
        _mark_full(voxels.coordinates, side, index)
        bricks = np.empty(64 * (1 + int(_number_full(index))), np.uint64)
        fill(bricks, ZERO)
        _store_full(voxels.coordinates, voxels.packed, side, index, bricks)
        return FullBricks(voxels.side, index, bricks)

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        return {"index": self.index, "bricks": self.bricks}

    def query(self, points: np.ndarray, packed: np.ndarray, occupied: np.ndarray) -> None:
        """See `workflows.paper.structures.dense.DenseVoxels.query`."""
        _query_full(points, self.side, np.uint64(-(-self.side // 4)), self.index, self.bricks, packed, occupied)
