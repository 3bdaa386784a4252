"""Data structures for the occupied voxels of a cubic grid, and point queries in them (EfficientNeRF, section 3.5 and table 7), in torch on any device.

    DenseVoxels  one value for each voxel of the grid
    HashMap      open addressing over 64-bit keys, as in MinkowskiEngine and spconv: the sparse tensor
    Octree       the node arrays of svox (PlenOctree)
    FullBricks   NerfTree as the paper prints it: a number for each coarse cell of 4^3 voxels, and bricks of 64 values, occupied or not
    BrickTree    NerfTree of occupied voxels only: bit masks of blocks of 4^3 coarse cells, of occupied cells, and values

All are built by gathers, scatters and scans from one list of voxels (`benchmarks.paper.voxels`), of which all give the same 64-bit words back.

N voxels, M points.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

CHUNK = 1 << 24  # points of a query that are processed at a time: temporary tensors of 128 MiB
LOAD_FACTOR = 0.5  # of the hash map


def _popcount(word: Tensor) -> Tensor:
    """Number of set bits of each int64."""
    word = word - ((word >> 1) & 0x5555555555555555)
    word = (word & 0x3333333333333333) + ((word >> 2) & 0x3333333333333333)
    return (((word + (word >> 4)) & 0x0F0F0F0F0F0F0F0F) * 0x0101010101010101) >> 56


def _rank(masks: Tensor, first: Tensor, at: Tensor, bit: Tensor) -> tuple[Tensor, Tensor]:
    """Index of a bit of a mask among all set bits, and whether it is set."""
    mask = masks[at]
    return first[at] + _popcount(mask & ((1 << bit) - 1)), ((mask >> bit) & 1).bool()


def _local_index(voxel: Tensor) -> Tensor:
    """Index among 4^3 of a voxel (..., 3) in its cell."""
    low = voxel & 3
    return (low[:, 0] << 4) | (low[:, 1] << 2) | low[:, 2]


def _flat_index(voxel: Tensor, side: int) -> Tensor:
    return (voxel[:, 0] * side + voxel[:, 1]) * side + voxel[:, 2]


@dataclass(frozen=True, eq=False)
class Structure(ABC):
    """A structure of `tensors` with `side` voxels along each side."""

    side: int
    tensors: dict[str, Tensor]

    @classmethod
    @abstractmethod
    def cache(cls, side: int, coordinates: Tensor, packed: Tensor) -> Self:
        """Build it from coordinates (N, 3) int32 and packed values (N,) int64."""

    def query(self, points: Tensor) -> Tensor:
        """Packed values (M,) int64 at points (M, 3), voxel coordinates; 0 in empty space and outside of the grid."""
        packed = torch.empty(len(points), dtype=torch.int64, device=points.device)
        for point, out in zip(points.split(CHUNK), packed.split(CHUNK), strict=True):
            inside = ((point >= 0) & (point < self.side)).all(dim=1)
            out[:] = torch.where(inside, self._at(torch.where(inside[:, None], point, torch.zeros_like(point)).long()), 0)
        return packed

    @abstractmethod
    def _at(self, voxel: Tensor) -> Tensor:
        """Packed values at voxels (m, 3) int64 of the grid, 0 where there is none."""


class DenseVoxels(Structure):
    """8 bytes for each voxel of the grid, x slowest."""

    @classmethod
    def cache(cls, side: int, coordinates: Tensor, packed: Tensor) -> Self:
        grid = torch.zeros(side**3, dtype=torch.int64, device=packed.device)
        grid[_flat_index(coordinates.long(), side)] = packed
        return cls(side, {"grid": grid})

    def _at(self, voxel: Tensor) -> Tensor:
        return self.tensors["grid"][_flat_index(voxel, self.side)]


class BrickTree(Structure):
    """NerfTree of occupied voxels only, found by 64-bit masks (x slowest), each with the number of its first set bit.

    blocks  masks of the 4^3 coarse cells of a block: a query of a point in an empty cell ends there
    cells   masks of the 4^3 voxels of each occupied cell
    values  of the occupied voxels, in the order of the cells
    """

    @classmethod
    def cache(cls, side: int, coordinates: Tensor, packed: Tensor) -> Self:
        blocks_side, device = -(-side // 16), packed.device
        masks = torch.zeros(64 * blocks_side**3, dtype=torch.int64, device=device)
        voxel = coordinates.long()
        cell, bit = (_flat_index(voxel >> 4, blocks_side) << 6) | _local_index(voxel >> 2), _local_index(voxel)
        masks.index_add_(0, cell, torch.ones_like(bit) << bit)  # each bit once: the sum is the union
        occupied = (masks != 0).view(-1, 64)
        blocks = (occupied.long() << torch.arange(64, device=device)).sum(dim=1)
        cells = masks[occupied.view(-1)]
        tensors = {"blocks": blocks, "blocks_first": _exclusive_sum(_popcount(blocks)), "cells": cells, "cells_first": _exclusive_sum(_popcount(cells))}
        record, _ = _rank(blocks, tensors["blocks_first"], cell >> 6, cell & 63)
        number, _ = _rank(cells, tensors["cells_first"], record, bit)
        tensors["values"] = torch.empty_like(packed).index_copy_(0, number, packed)
        return cls(side, tensors)

    def _at(self, voxel: Tensor) -> Tensor:
        t = self.tensors
        out = torch.zeros(len(voxel), dtype=torch.int64, device=voxel.device)
        record, occupied = _rank(t["blocks"], t["blocks_first"], _flat_index(voxel >> 4, -(-self.side // 16)), _local_index(voxel >> 2))
        rest = occupied.nonzero()[:, 0]
        number, occupied = _rank(t["cells"], t["cells_first"], record[rest], _local_index(voxel[rest]))
        out[rest[occupied]] = t["values"][number[occupied]]
        return out


def _exclusive_sum(counts: Tensor) -> Tensor:
    return counts.cumsum(0) - counts


class FullBricks(Structure):
    """NerfTree as printed; number 0 is an empty brick."""

    @classmethod
    def cache(cls, side: int, coordinates: Tensor, packed: Tensor) -> Self:
        cells_side, voxel = -(-side // 4), coordinates.long()
        cell = _flat_index(voxel >> 2, cells_side)
        occupied = torch.zeros(cells_side**3, dtype=torch.int32, device=packed.device)
        occupied[cell] = 1
        index = occupied.cumsum(0, dtype=torch.int32) * occupied
        bricks = torch.zeros(64 * (1 + int(occupied.sum())), dtype=torch.int64, device=packed.device)
        bricks[(index[cell].long() << 6) | _local_index(voxel)] = packed
        return cls(side, {"index": index, "bricks": bricks})

    def _at(self, voxel: Tensor) -> Tensor:
        brick = self.tensors["index"][_flat_index(voxel >> 2, -(-self.side // 4))].long()
        return self.tensors["bricks"][(brick << 6) | _local_index(voxel)]


class HashMap(Structure):
    """Linear probing. All keys are inserted, and queried, in lockstep: of those that write to one free slot one wins, and the others probe the next."""

    @classmethod
    def cache(cls, side: int, coordinates: Tensor, packed: Tensor) -> Self:
        slots = max(int(len(packed) / LOAD_FACTOR), 1)
        keys = torch.full((slots,), -1, dtype=torch.int64, device=packed.device)
        values = torch.zeros(slots, dtype=torch.int64, device=packed.device)
        key = _keys(coordinates.long())
        slot, word = _home(key, slots), packed
        while len(key):
            free = keys[slot] == -1
            keys[slot[free]] = key[free]
            won = keys[slot] == key
            values[slot[won]] = word[won]
            key, word, slot = key[~won], word[~won], (slot[~won] + 1) % slots
        return cls(side, {"keys": keys, "values": values})

    def _at(self, voxel: Tensor) -> Tensor:
        keys, values = self.tensors["keys"], self.tensors["values"]
        key = _keys(voxel)
        out, slot, active = torch.zeros_like(key), _home(key, len(keys)), torch.arange(len(key), device=key.device)
        while len(active):
            held = keys[slot]
            hit, missed = held == key, held == -1
            out[active[hit]] = values[slot[hit]]
            left = ~(hit | missed)
            active, key, slot = active[left], key[left], (slot[left] + 1) % len(keys)
        return out


def _keys(voxel: Tensor) -> Tensor:
    return (voxel[:, 0] << 42) | (voxel[:, 1] << 21) | voxel[:, 2]


def _home(key: Tensor, slots: int) -> Tensor:
    """murmur3's 64-bit finaliser, its upper half scaled to the table."""
    key = (key ^ _shift_right(key, 33)) * (0xFF51AFD7ED558CCD - (1 << 64))
    key = (key ^ _shift_right(key, 33)) * (0xC4CEB9FE1A85EC53 - (1 << 64))
    return (_shift_right(key ^ _shift_right(key, 33), 32) * slots) >> 32


def _shift_right(word: Tensor, by: int) -> Tensor:
    """Logical right shift."""
    return (word >> by) & ((1 << (64 - by)) - 1)


class Octree(Structure):
    """A row for each node, a column for each octant: `child` holds the offset in rows to the child node, 0 for a leaf; `data` the leaf's values, 0 where it is
    empty. As in svox every node has both rows. Nodes are numbered level after level in Morton order; svox refines from the root, in Python.
    """

    @classmethod
    def cache(cls, side: int, coordinates: Tensor, packed: Tensor) -> Self:
        depth = _depth(side)
        code = _morton(coordinates.long())
        levels = [torch.unique(code >> 3)]  # codes of the nodes of a level, in order; the lowest first
        while len(levels) < depth:
            levels.append(torch.unique_consecutive(levels[-1] >> 3))
        if not len(packed):
            levels = [*levels[:-1], torch.zeros(1, dtype=torch.int64, device=packed.device)]
        levels.reverse()
        begins = [0]
        for level in levels:
            begins.append(begins[-1] + len(level))
        child = torch.zeros(8 * begins[-1], dtype=torch.int32, device=packed.device)
        data = torch.zeros(8 * begins[-1], dtype=torch.int64, device=packed.device)
        for number in range(1, depth):
            parent = begins[number - 1] + torch.searchsorted(levels[number - 1], levels[number] >> 3)
            node = begins[number] + torch.arange(len(levels[number]), device=packed.device)
            child[(parent << 3) | (levels[number] & 7)] = (node - parent).int()
        data[((begins[-2] + torch.searchsorted(levels[-1], code >> 3)) << 3) | (code & 7)] = packed
        return cls(side, {"child": child, "data": data})

    def _at(self, voxel: Tensor) -> Tensor:
        code = _morton(voxel)
        out, node, active = torch.zeros_like(code), torch.zeros_like(code), torch.arange(len(code), device=code.device)
        for level in range(_depth(self.side) - 1, 0, -1):
            skip = self.tensors["child"][(node << 3) | ((code >> (3 * level)) & 7)].long()
            inner = skip != 0
            active, code, node = active[inner], code[inner], (node + skip)[inner]
        out[active] = self.tensors["data"][(node << 3) | (code & 7)]
        return out


def _depth(side: int) -> int:
    """Levels of nodes of an octree."""
    return max((side - 1).bit_length(), 1)


def _morton(voxel: Tensor) -> Tensor:
    x, y, z = (_spread(voxel[:, axis]) for axis in range(3))
    return (x << 2) | (y << 1) | z


def _spread(x: Tensor) -> Tensor:
    """Two zero bits between any two of the lowest 21 bits."""
    for by, keep in ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249)):
        x = (x | (x << by)) & keep
    return x
