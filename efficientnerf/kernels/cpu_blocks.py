"""Blocks of a packed tree (numba): bricks with the one layer of voxels round them, laid out where and when the rays of a picture come by.

A ray looks up points whose eight voxels lie in up to eight bricks. A block has them side by side, (b + 2)^3 of them with four numbers each, so that no
look-up leaves it: density, red, green, blue. The colours are what the sigmoid is taken of, the sum of the harmonics along the line of sight to the
voxel: all rays of a picture pass its camera's centre, so that each voxel is seen along one direction, and its harmonics are summed once instead of
at every sample.

A thread has a pool of blocks, filled one after the other; when it is full the block that was filled first makes room. What a block holds does not
depend on who filled it and when, and so no picture depends on threads or on the pool's size.

B bricks, N stored voxels, K harmonics, S blocks of a pool; b = brick.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np

from efficientnerf import harmonics
from efficientnerf.kernels.lanes import apart, four_at, plus_scaled, pointer, scaled

POOL_BYTES = 4 * 2**20  # of a thread's blocks

# Sums may be taken in any order and products fused; infinities and no-numbers keep their meaning.
LOOSE = {"contract", "reassoc", "arcp", "nsz"}

# What a block holds in the place of colours.
VOXELS, COLOURS, EXACT = 0, 1, 2

_HALF, _ONE = np.float32(0.5), np.float32(1)
_C0 = np.float32(harmonics.C0)
_C1 = np.float32(harmonics.C1)
_C2 = tuple(np.float32(c) for c in harmonics.C2)
_C3 = tuple(np.float32(c) for c in harmonics.C3)
_C4 = tuple(np.float32(c) for c in harmonics.C4)


class View(NamedTuple):
    """Where rays come from.

    x, y, z  the point that they all pass, voxel coordinates
    nearest  voxels from that point within which blocks hold no colours, but which voxels they have: there a voxel's direction is not its samples'.
             Infinity where rays pass no common point.
    scale    float32: what densities are multiplied with
    degree   of the harmonics
    """

    x: float
    y: float
    z: float
    nearest: float
    scale: np.float32
    degree: int


class Grid(NamedTuple):
    """A `Packed`, arrays as pointers, and sizes: of a brick, of the coarse level, K, G and P; `coded` is whether there are codes."""

    brick: int
    nx: int
    ny: int
    nz: int
    leap: Any
    place: Any
    brick_index: Any
    voxel_index: Any
    density: Any
    terms: int
    coded: bool
    sh: Any
    base: Any
    base_table: Any
    codes: Any
    groups: int
    palette: Any
    entries: int
    column: Any


class Pool(NamedTuple):
    """The blocks of one thread, arrays as pointers.

    size    numbers in a block: 4 (b + 2)^3
    blocks  S
    slot    (B,) int32: which block a brick has, or -1
    owner   (S,) int32: which brick a block is of, or -1
    kind    (S,) uint8: VOXELS, COLOURS or EXACT
    next    (1,) int64: the block that is filled next
    values  (S, size) float32: density, red, green, blue of voxel (i - 1, j - 1, k - 1) of the brick at 4 ((i (b + 2) + j) (b + 2) + k);
            no-numbers for the colours of what is not stored; the density is -0.0 where all eight voxels from there on have none.
            Where the kind is not COLOURS there is in the place of red which stored voxel it is as int32, or -1
    words   the same as int32
    basis   (K,) float32, room for harmonics
    """

    size: int
    blocks: int
    slot: Any
    owner: Any
    kind: Any
    next: Any
    values: Any
    words: Any
    basis: Any


@numba.njit(cache=True, inline="always", error_model="numpy")
def grid_of(packed, brick):  # type: ignore[no-untyped-def]
    """The arrays of a Packed as pointers."""
    return Grid(
        brick, packed.leap.shape[0], packed.leap.shape[1], packed.leap.shape[2], pointer(packed.leap), pointer(packed.place),
        pointer(packed.brick_index), pointer(packed.voxel_index), pointer(packed.density), packed.sh.shape[1], len(packed.codes) > 0,
        pointer(packed.sh), pointer(packed.base), pointer(packed.base_table), pointer(packed.codes), packed.codes.shape[1],
        pointer(packed.palette), packed.palette.shape[1], pointer(packed.column),
    )  # fmt: skip


@numba.njit(cache=True, error_model="numpy", fastmath=LOOSE)
def basis_into(x, y, z, degree, out):  # type: ignore[no-untyped-def]
    """`efficientnerf.harmonics.basis` of one direction into (K,)."""
    two, three, four, seven = np.float32(2), np.float32(3), np.float32(4), np.float32(7)
    xx, yy, zz = x * x, y * y, z * z
    out[0] = _C0
    if degree > 0:
        out[1], out[2], out[3] = -_C1 * y, _C1 * z, -_C1 * x
    if degree > 1:
        out[4], out[5], out[6] = _C2[0] * x * y, _C2[1] * y * z, _C2[2] * (two * zz - xx - yy)
        out[7], out[8] = _C2[3] * x * z, _C2[4] * (xx - yy)
    if degree > 2:
        out[9], out[10], out[11] = _C3[0] * y * (three * xx - yy), _C3[1] * x * y * z, _C3[2] * y * (four * zz - xx - yy)
        out[12] = _C3[3] * z * (two * zz - three * xx - three * yy)
        out[13], out[14], out[15] = _C3[4] * x * (four * zz - xx - yy), _C3[5] * z * (xx - yy), _C3[6] * x * (xx - three * yy)
    if degree > 3:
        out[16], out[17] = _C4[0] * x * y * (xx - yy), _C4[1] * y * z * (three * xx - yy)
        out[18], out[19] = _C4[2] * x * y * (seven * zz - _ONE), _C4[3] * y * z * (seven * zz - three)
        out[20] = _C4[4] * (zz * (np.float32(35) * zz - np.float32(30)) + three)
        out[21], out[22] = _C4[5] * x * z * (seven * zz - three), _C4[6] * (xx - yy) * (seven * zz - _ONE)
        out[23], out[24] = _C4[7] * x * z * (xx - three * yy), _C4[8] * (xx * (xx - three * yy) - yy * (three * xx - yy))


@numba.njit(cache=True, inline="always", error_model="numpy")
def _beside(owner, a, e, c, grid):  # type: ignore[no-untyped-def]
    """The brick (a, e, c) cells away from one, or -1."""
    x, y, z = grid.place[3 * owner] + a, grid.place[3 * owner + 1] + e, grid.place[3 * owner + 2] + c
    other = np.int64(-1)
    if 0 <= x < grid.nx and 0 <= y < grid.ny and 0 <= z < grid.nz:
        other = np.int64(grid.brick_index[(x * grid.ny + y) * grid.nz + z])
    return other


@numba.njit(cache=True, error_model="numpy")
def _voxels_into(owner, grid, scale, values, words, begin):  # type: ignore[no-untyped-def]
    """Densities and which voxels they are of into the block that begins there."""
    brick, side, index, none = grid.brick, grid.brick + 2, grid.voxel_index, np.int32(-1)
    cube = brick * brick * brick
    for n in range(9):
        p, q = n // 3, n % 3
        before, here, after = _beside(owner, p - 1, q - 1, -1, grid), _beside(owner, p - 1, q - 1, 0, grid), _beside(owner, p - 1, q - 1, 1, grid)
        # Rows of the block that are those neighbours': one layer where they are beside the brick.
        i0, i1 = (0, 1) if p == 0 else (1, side - 1) if p == 1 else (side - 1, side)
        j0, j1 = (0, 1) if q == 0 else (1, side - 1) if q == 1 else (side - 1, side)
        for i in range(i0, i1):
            for j in range(j0, j1):
                at = begin + 4 * (i * side + j) * side + 1
                row = ((i - 1 - (p - 1) * brick) * brick + j - 1 - (q - 1) * brick) * brick
                words[at] = index[before * cube + row + brick - 1] if before >= 0 else none
                words[at + 4 * (side - 1)] = index[after * cube + row] if after >= 0 else none
                if here >= 0:
                    for k in range(brick):
                        words[at + 4 * k + 4] = index[here * cube + row + k]
                else:
                    for k in range(brick):
                        words[at + 4 * k + 4] = none
    # In a loop of its own and without branches: what is looked up lies far away, and waiting for one should not keep from asking for the next.
    for n in range(side * side * side):
        index = words[begin + 4 * n + 1]
        values[begin + 4 * n] = grid.density[max(index, np.int32(0))] * (scale if index >= 0 else np.float32(0))
    _mark_idle(values, begin, side)


@numba.njit(cache=True, error_model="numpy")
def _mark_idle(values, begin, side):  # type: ignore[no-untyped-def]
    """-0.0 at the low corners of eight voxels without density."""
    j, i = 4 * side, 4 * side * side
    for n in range(side - 1):
        for m in range(side - 1):
            at = begin + n * i + m * j
            before = values[at] + values[at + j] + values[at + i] + values[at + i + j]
            for _ in range(side - 1):
                at += 4
                after = values[at] + values[at + j] + values[at + i] + values[at + i + j]
                if before + after == 0:
                    values[at - 4] = np.float32(-0.0)
                before = after


@numba.njit(cache=True, inline="always", error_model="numpy", fastmath=LOOSE)
def sum_of_harmonics(n, grid, basis):  # type: ignore[no-untyped-def]
    """Red, green and blue of stored voxel n before the sigmoid, seen along the direction that `basis` is of."""
    y = basis[0]
    if grid.coded:
        table, base, code = grid.base_table, 3 * n, n * grid.groups
        r, g, b = y * table[3 * np.int64(grid.base[base])], y * table[3 * np.int64(grid.base[base + 1]) + 1], y * table[3 * np.int64(grid.base[base + 2]) + 2]
        if grid.terms > 1:
            total = scaled(basis[1], four_at(grid.palette, 4 * np.int64(grid.codes[code + grid.column[0]])))
            for k in range(1, grid.terms - 1):
                e = k * grid.entries + np.int64(grid.codes[code + grid.column[k]])
                total = plus_scaled(total, basis[k + 1], four_at(grid.palette, 4 * e))
            _, red, green, blue = apart(total)
            r, g, b = r + red, g + green, b + blue
    else:
        e = 3 * grid.terms * n
        r, g, b = y * grid.sh[e], y * grid.sh[e + 1], y * grid.sh[e + 2]
        for k in range(1, grid.terms):
            y = basis[k]
            r += y * grid.sh[e + 3 * k]
            g += y * grid.sh[e + 3 * k + 1]
            b += y * grid.sh[e + 3 * k + 2]
    return r, g, b


@numba.njit(cache=True, inline="always", error_model="numpy")
def _painted(owner, a, e, c, grid, pool):  # type: ignore[no-untyped-def]
    """Where the block of the brick beside one begins, (a, e, c) cells away, if it has colours; else -1."""
    other, begin = _beside(owner, a, e, c, grid), np.int64(-1)
    if other >= 0:
        slot = np.int64(pool.slot[other])
        if slot >= 0 and pool.kind[slot] == COLOURS:
            begin = slot * pool.size
    return begin


@numba.njit(cache=True, error_model="numpy", fastmath=LOOSE)
def _colours_into(owner, grid, view, pool, begin):  # type: ignore[no-untyped-def]
    """Colours in the place of voxels into the block that begins there.

    Two layers on each side lie in the neighbour's block as well, and are taken from there where they are known: a voxel's colour is the same
    whichever block asks for it.
    """
    words, values, basis, brick = pool.words, pool.values, pool.basis, grid.brick
    side, none = brick + 2, np.float32(np.nan)
    x0, x1 = _painted(owner, -1, 0, 0, grid, pool), _painted(owner, 1, 0, 0, grid, pool)
    y0, y1 = _painted(owner, 0, -1, 0, grid, pool), _painted(owner, 0, 1, 0, grid, pool)
    z0, z1 = _painted(owner, 0, 0, -1, grid, pool), _painted(owner, 0, 0, 1, grid, pool)
    place = grid.place
    ax, ay, az = place[3 * owner] * brick - 0.5 - view.x, place[3 * owner + 1] * brick - 0.5 - view.y, place[3 * owner + 2] * brick - 0.5 - view.z
    at = begin
    for i in range(side):
        dx = np.float32(ax + i)
        from_x = x0 + 4 * brick * side * side if i < 2 and x0 >= 0 else x1 - 4 * brick * side * side if i >= side - 2 and x1 >= 0 else -1
        for j in range(side):
            dy = np.float32(ay + j)
            from_y = y0 + 4 * brick * side if j < 2 and y0 >= 0 else y1 - 4 * brick * side if j >= side - 2 and y1 >= 0 else -1
            for k in range(side):
                n = np.int64(words[at + 1])
                r = g = b = none
                if n >= 0:
                    source = from_x if from_x >= 0 else from_y
                    if source < 0:
                        source = z0 + 4 * brick if k < 2 and z0 >= 0 else z1 - 4 * brick if k >= side - 2 and z1 >= 0 else -1
                    if source >= 0:
                        source += at - begin
                        r, g, b = values[source + 1], values[source + 2], values[source + 3]
                    else:
                        dz = np.float32(az + k)
                        share = _ONE / np.sqrt(dx * dx + dy * dy + dz * dz)
                        basis_into(dx * share, dy * share, dz * share, view.degree, basis)
                        r, g, b = sum_of_harmonics(n, grid, basis)
                values[at + 1], values[at + 2], values[at + 3] = r, g, b
                at += 4


@numba.njit(cache=True, error_model="numpy")
def fill(owner, grid, scale, pool):  # type: ignore[no-untyped-def]
    """Gives a brick a block of the kind VOXELS; which one."""
    slot = np.int32(pool.next[0])
    pool.next[0] = (slot + 1) % pool.blocks
    if pool.owner[slot] >= 0:
        pool.slot[pool.owner[slot]] = -1
    pool.slot[owner], pool.owner[slot], pool.kind[slot] = slot, owner, VOXELS
    _voxels_into(owner, grid, scale, pool.values, pool.words, slot * pool.size)
    return slot


@numba.njit(cache=True, error_model="numpy")
def colour(slot, grid, view, pool):  # type: ignore[no-untyped-def]
    """Makes a block of the kind VOXELS one of COLOURS, or EXACT where these would not be true of all samples; its kind."""
    owner = np.int64(pool.owner[slot])
    x = (grid.place[3 * owner] + 0.5) * grid.brick - view.x
    y = (grid.place[3 * owner + 1] + 0.5) * grid.brick - view.y
    z = (grid.place[3 * owner + 2] + 0.5) * grid.brick - view.z
    if np.sqrt(x * x + y * y + z * z) >= view.nearest + 2 * grid.brick + 4 or view.degree == 0:
        _colours_into(owner, grid, view, pool, slot * pool.size)
        pool.kind[slot] = COLOURS
    else:
        pool.kind[slot] = EXACT
    return pool.kind[slot]
