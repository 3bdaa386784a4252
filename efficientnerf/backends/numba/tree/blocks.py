"""Blocks of a packed tree (numba): bricks with the layer of voxels around them, laid out when the rays of an image reach them.

A point's eight voxels lie in up to eight bricks. A block has them side by side, (b + 2)^3 voxels of four numbers, density, red, green, blue, so that no lookup
leaves it. The colours are those of `view_colours`, before the sigmoid.

Each thread has a pool of blocks, filled in turn; when it is full, the oldest are replaced. The content of a block does not depend on who filled it and when:
images depend neither on threads nor on the size of the pool.

B bricks, N stored voxels, S blocks of a pool; b = brick.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.simd import load4, popcount, store4
from efficientnerf.backends.numba.tree.view_colours import view_direction

POOL_BYTES = 4 * 2**20  # of a thread's blocks
QUEUE = 4  # samples that are composited together; the blocks of pending ones stay in the pool
MIN_BLOCKS = QUEUE + 1

# What a block holds beside densities: colours of the view, or indices of stored voxels.
VIEW_COLOURS, VOXEL_INDICES = 0, 1


class Pool(NamedTuple):
    """The blocks of one thread, arrays as pointers.

    block_size    numbers in a block: 4 (b + 2)^3
    capacity      S; block S is empty
    slot_of       (B,) int32: the block of a brick, or -1
    brick_of      (S,) int32: the brick of a block, or -1
    kind          (S,) uint8: VIEW_COLOURS or VOXEL_INDICES
    next          (2,) int64: the block that is filled next, and how many voxels were filled in
    values        (S + 1, block_size) float32: density, red, green, blue of voxel (i - 1, j - 1, k - 1) of the brick at 4 ((i (b + 2) + j) (b + 2) + k); colours
                  that are not stored are NaN. For VOXEL_INDICES, red is the index of the stored voxel as int32, or -1
    ints          `values` as int32
    view_colours  (N + 1, 4) float32: see `compute_view_colours`
    absent        N
    voxels        ((b + 2)^3,) int32, scratch
    pending       (QUEUE,) int64: where the samples that are not composited yet lie in `values`
    """

    block_size: int
    capacity: int
    slot_of: Any
    brick_of: Any
    kind: Any
    next: Any
    values: Any
    ints: Any
    view_colours: Any
    absent: int
    voxels: Any
    pending: Any


@numba.njit(cache=True, inline="always", error_model="numpy")
def _neighbour(owner, a, e, c, grid):  # type: ignore[no-untyped-def]
    """The brick (a, e, c) cells away from `owner`, or B where there is none."""
    x, y, z = grid.cells[3 * owner] + a, grid.cells[3 * owner + 1] + e, grid.cells[3 * owner + 2] + c
    other = np.int64(-1)
    if 0 <= x < grid.nx and 0 <= y < grid.ny and 0 <= z < grid.nz:
        other = np.int64(grid.brick_index[(x * grid.ny + y) * grid.nz + z])
    return other if other >= 0 else grid.bricks


@numba.njit(cache=True, inline="always", error_model="numpy")
def _stored_index(owner, n, grid):  # type: ignore[no-untyped-def]
    """Index of the stored voxel that is the n-th of a brick, or -1."""
    at = 2 * (owner * grid.rank_words + (n >> 6))
    mask, bit = grid.stored_ranks[at], np.int64(1) << (n & 63)
    index = grid.stored_ranks[at + 1] + popcount(mask & (bit - 1))
    return np.int32(index if mask & bit != 0 else -1)


@numba.njit(cache=True, error_model="numpy")
def _block_voxels(owner, grid, voxels):  # type: ignore[no-untyped-def]
    """Indices of the stored voxels of a block, or -1, into ((b + 2)^3,)."""
    brick, side = grid.brick, grid.brick + 2
    for n in range(9):
        p, q = n // 3, n % 3
        before, here, after = _neighbour(owner, p - 1, q - 1, -1, grid), _neighbour(owner, p - 1, q - 1, 0, grid), _neighbour(owner, p - 1, q - 1, 1, grid)
        # The rows of the block that belong to these neighbours: one layer where they are beside the brick.
        i0, i1 = (0, 1) if p == 0 else (1, side - 1) if p == 1 else (side - 1, side)
        j0, j1 = (0, 1) if q == 0 else (1, side - 1) if q == 1 else (side - 1, side)
        for i in range(i0, i1):
            for j in range(j0, j1):
                at = (i * side + j) * side
                row = ((i - 1 - (p - 1) * brick) * brick + j - 1 - (q - 1) * brick) * brick
                voxels[at] = _stored_index(before, row + brick - 1, grid)
                voxels[at + side - 1] = _stored_index(after, row, grid)
                for k in range(brick):
                    voxels[at + k + 1] = _stored_index(here, row + k, grid)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _has_pending(slot, pool):  # type: ignore[no-untyped-def]
    """Whether a pending sample lies in a block."""
    found = False
    for n in range(QUEUE):
        found = found or pool.pending[n] // pool.block_size == slot
    return found


@numba.njit(cache=True, error_model="numpy")
def fill_block(owner, grid, view, pool):  # type: ignore[no-untyped-def]
    """Assigns a block to a brick and fills it; returns its slot. The view's colours where they hold for all samples in it, else voxel indices."""
    slot = pool.next[0]
    while _has_pending(slot, pool):
        slot = (slot + 1) % pool.capacity
    pool.next[0] = (slot + 1) % pool.capacity
    pool.next[1] += pool.block_size // 4
    before = pool.brick_of[slot]
    if before >= 0:
        pool.slot_of[before] = -1
    pool.slot_of[owner], pool.brick_of[slot] = slot, owner
    half = 0.5 * grid.brick
    x, y, z = grid.cells[3 * owner] * grid.brick + half, grid.cells[3 * owner + 1] * grid.brick + half, grid.cells[3 * owner + 2] * grid.brick + half
    dx, dy, dz = view_direction(x, y, z, view.direction)
    begin, voxels = slot * pool.block_size, pool.block_size // 4
    _block_voxels(owner, grid, pool.voxels)
    # Branch-free, so that the loads of several voxels are in flight at once.
    if np.sqrt(dx * dx + dy * dy + dz * dz) >= view.direction_rate * (view.min_distance + 2 * grid.brick + 4):
        pool.kind[slot] = VIEW_COLOURS
        for n in range(voxels):
            voxel = np.int64(pool.voxels[n])
            store4(pool.values, begin + 4 * n, load4(pool.view_colours, 4 * (voxel if voxel >= 0 else pool.absent)))
    else:
        pool.kind[slot] = VOXEL_INDICES
        for n in range(voxels):
            voxel = pool.voxels[n]
            pool.values[begin + 4 * n] = grid.density[max(voxel, np.int32(0))] * (view.density_scale if voxel >= 0 else np.float32(0))
            pool.ints[begin + 4 * n + 1] = voxel
    return slot
