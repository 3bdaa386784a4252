"""Octree with the node arrays of svox, the library of PlenOctree (Yu et al. 2021).

Two arrays with a row per node and a column per octant. `child` holds the offset in rows to the child node, 0 for a leaf; `data` holds the leaf's values, zeros
where it is empty. As in svox every node has both rows: the lowest nodes carry eight zeros in `child`, the others `data` of empty octants. Unlike svox a query
knows the depth: it reads neither the `child` of the lowest nodes nor the data of empty octants above them, which is zero.

svox refines level by level from the root, in Python. Here nodes are numbered from bit masks in Morton order, level after level, so that the children of a node,
and neighbours in space, are adjacent.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from workflows.paper.structures.bits import CHUNK, ONE, TASK, ZERO, assign_ranks, atomic_or, fill, floor_to_uint64, in_grid, rank
from workflows.paper.structures.voxels import Voxels

THREE, SIX, SEVEN = np.uint64(3), np.uint64(6), np.uint64(7)
NONE = np.uint64(0xFFFFFFFFFFFFFFFF)


@numba.njit(cache=True, inline="always")
def _spread(x):  # type: ignore[no-untyped-def]
    """Two zero bits between any two of the lowest 21 bits."""
    x = (x | (x << np.uint64(32))) & np.uint64(0x1F00000000FFFF)
    x = (x | (x << np.uint64(16))) & np.uint64(0x1F0000FF0000FF)
    x = (x | (x << np.uint64(8))) & np.uint64(0x100F00F00F00F00F)
    x = (x | (x << np.uint64(4))) & np.uint64(0x10C30C30C30C30C3)
    return (x | (x << np.uint64(2))) & np.uint64(0x1249249249249249)


@numba.njit(cache=True, inline="always")
def _morton(x, y, z):  # type: ignore[no-untyped-def]
    """Octants of voxel (x, y, z) from the root down, three bits each, x first."""
    return (_spread(x) << np.uint64(2)) | (_spread(y) << ONE) | _spread(z)


@numba.njit(cache=True, inline="always")
def _node_index(records, cell):  # type: ignore[no-untyped-def]
    """Index of the node of an occupied cell of a level."""
    record = (cell >> SIX) << ONE
    return records[record | ONE] + rank(records[record], cell & np.uint64(63))


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _mark(coordinates, records):  # type: ignore[no-untyped-def]
    """Sets the bits of occupied cells of 2^3 voxels."""
    n = len(coordinates)
    for task in numba.prange((n + TASK - 1) // TASK):
        current, mask = NONE, ZERO
        for i in range(task * TASK, min(n, (task + 1) * TASK)):
            cell = _morton(floor_to_uint64(coordinates[i, 0]), floor_to_uint64(coordinates[i, 1]), floor_to_uint64(coordinates[i, 2])) >> THREE
            if cell >> SIX != current:
                if current != NONE:
                    atomic_or(records, current << ONE, mask)
                current, mask = cell >> SIX, ZERO
            mask |= ONE << (cell & np.uint64(63))
        atomic_or(records, current << ONE, mask)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _raise(below, above):  # type: ignore[no-untyped-def]
    """Masks of the level above: a cell has a node if any of its eight children has one."""
    for word in numba.prange(len(above) // 2):
        mask = ZERO
        for octet in range(min(8, len(below) // 2 - 8 * word)):
            children = below[2 * (8 * word + octet)]
            for byte in range(8):
                if (children >> np.uint64(8 * byte)) & np.uint64(0xFF):
                    mask |= ONE << np.uint64(8 * octet + byte)
        above[2 * word] = mask


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _link(above, level, child):  # type: ignore[no-untyped-def]
    """Writes the offset of each node of a level from its parent."""
    masks = len(level) // 2
    for task in numba.prange((masks + 63) // 64):
        for word in range(task * 64, min(masks, (task + 1) * 64)):
            mask, node = level[2 * word], level[2 * word + 1]
            for bit in range(64):
                if (mask >> np.uint64(bit)) & ONE:
                    parent = _node_index(above, np.uint64(64 * word + bit) >> THREE)
                    child[(parent << THREE) | np.uint64(bit & 7)] = np.int32(node - parent)
                    node += ONE


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _store(coordinates, packed, lowest, data):  # type: ignore[no-untyped-def]
    n = len(coordinates)
    for task in numba.prange((n + TASK - 1) // TASK):
        for i in range(task * TASK, min(n, (task + 1) * TASK)):
            code = _morton(floor_to_uint64(coordinates[i, 0]), floor_to_uint64(coordinates[i, 1]), floor_to_uint64(coordinates[i, 2]))
            data[(_node_index(lowest, code >> THREE) << THREE) | (code & SEVEN)] = packed[i]


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _query(points, side, depth, child, data, packed, occupied):  # type: ignore[no-untyped-def]
    """Descends level by level with a chunk of points; points that reach a leaf drop out."""
    n, top = len(points), np.float32(side)
    for task in numba.prange((n + TASK - 1) // TASK):
        code, node, leaf, word = np.empty(CHUNK, np.uint64), np.empty(CHUNK, np.uint64), np.empty(CHUNK, np.uint64), np.empty(CHUNK, np.uint64)
        active, still = np.empty(CHUNK, np.uint64), np.empty(CHUNK, np.uint64)
        for begin in range(task * TASK, min(n, (task + 1) * TASK), CHUNK):
            end = min(begin + CHUNK, n)
            point, out, there = points[begin:end], packed[begin:end], occupied[begin:end]
            size, count = np.uint64(end - begin), ZERO
            for i in range(size):
                x, y, z = point[i, 0], point[i, 1], point[i, 2]
                code[i], node[i], word[i] = _morton(floor_to_uint64(x), floor_to_uint64(y), floor_to_uint64(z)), ZERO, ZERO
                active[count] = i
                count += np.uint64(in_grid(x, y, z, top))
            for level in range(depth - 1):
                shift, left = np.uint64(3 * (depth - 1 - level)), ZERO
                for a in range(count):
                    i = active[a]
                    skip = np.uint64(child[(node[i] << THREE) | ((code[i] >> shift) & SEVEN)])
                    node[i] += skip
                    still[left] = i
                    left += np.uint64(skip != ZERO)
                active, still, count = still, active, left
            for a in range(count):
                i = active[a]
                leaf[a] = (node[i] << THREE) | (code[i] & SEVEN)
            for a in range(count):
                word[active[a]] = data[leaf[a]]
            for i in range(size):
                out[i] = word[i]
                there[i] = word[i] != ZERO


@dataclass(frozen=True, eq=False)
class Octree:
    """side voxels along each side of the grid, inside a cube of 2^depth; B nodes.

    child  (8 B,) int32
    data   (8 B,) uint64
    """

    side: int
    depth: int
    child: np.ndarray
    data: np.ndarray

    @staticmethod
    def cache(voxels: Voxels) -> Octree:
        depth = max((voxels.side - 1).bit_length(), 1)
        levels = [np.zeros(2 * max(8**number // 64, 1), np.uint64) for number in range(depth)]  # masks and numbers of the nodes
        if len(voxels.packed):
            _mark(voxels.coordinates, levels[-1])
        for number in range(depth - 1, 0, -1):
            _raise(levels[number], levels[number - 1])
        levels[0][0] = 1  # the root, also of an empty tree
        nodes = 0
        for records in levels:
            nodes = int(assign_ranks(records, np.uint64(nodes)))
        child, data = np.empty(8 * nodes, np.int32), np.empty(8 * nodes, np.uint64)
        fill(child, np.int32(0))
        fill(data, ZERO)
        for above, level in pairwise(levels):
            _link(above, level, child)
        _store(voxels.coordinates, voxels.packed, levels[-1], data)
        return Octree(voxels.side, depth, child, data)

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        return {"child": self.child, "data": self.data}

    def query(self, points: np.ndarray, packed: np.ndarray, occupied: np.ndarray) -> None:
        """See `workflows.paper.structures.dense.DenseVoxels.query`."""
        _query(points, self.side, self.depth, self.child, self.data, packed, occupied)
