"""Blocks of a packed tree (numba): bricks with the one layer of voxels round them, laid out where and when the rays of a picture come by.

A ray looks up points whose eight voxels lie in up to eight bricks. A block has them side by side, (b + 2)^3 of them with four numbers each, so that no
look-up leaves it: density, red, green, blue. The colours are what the sigmoid is taken of, the sum of the harmonics along the line of sight to the
voxel: all rays of a picture pass its camera's centre, so that each voxel is seen along one direction, and its harmonics are summed once instead of
at every sample. That is done for all voxels before the first ray, in the order in which they lie in memory: reading on from voxel to voxel costs a
fraction of what it costs to come back for those that a block lacks.

A thread has a pool of blocks, filled one after the other; when it is full what was filled first makes room. What is in a block does not depend on who
filled it and when, and so no picture depends on threads or on the pool's size.

B bricks, N stored voxels, K harmonics, S blocks of a pool; b = brick.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.simd import (
    add_scaled4,
    add_scaled_gathered16,
    broadcast_like,
    load4,
    pack4,
    pointer,
    popcount,
    rsqrt4,
    scale4,
    split16,
    store,
    store4,
    unpack4,
    zeros16,
)  # fmt: skip
from efficientnerf.rendering import harmonics

POOL_BYTES = 4 * 2**20  # of a thread's blocks
QUEUE = 4  # samples that wait to be composited together; the blocks that they lie in stay in the pool
LEAST_BLOCKS = QUEUE + 1
BRICKS = 256  # whose voxels a thread paints in a row

# Sums may be taken in any order and products fused; infinities and no-numbers keep their meaning.
LOOSE = {"contract", "reassoc", "arcp", "nsz"}

# What a block holds beside densities.
COLOURS, EXACT = 0, 1

_ONE = np.float32(1)
_C0 = np.float32(harmonics.C0)
_C1 = np.float32(harmonics.C1)
_C2 = tuple(np.float32(c) for c in harmonics.C2)
_C3 = tuple(np.float32(c) for c in harmonics.C3)
_C4 = tuple(np.float32(c) for c in harmonics.C4)


class View(NamedTuple):
    """Where rays come from.

    toward   12 numbers, (3, 4): the direction along which a point (x, y, z, 1), voxel coordinates, is seen, in the harmonics' frame and of any length
    stretch  by how much a step of one voxel changes that direction at most
    nearest  voxels from the point where `toward` is zero, on the scale of `stretch`, within which blocks hold no colours, but which voxels they have: there
             a voxel's direction is not its samples'. Infinity where rays pass no common point.
    scale    float32: what densities are multiplied with
    degree   of the harmonics
    """

    toward: Any
    stretch: float
    nearest: float
    scale: np.float32
    degree: int


class Grid(NamedTuple):
    """A `Packed`, arrays as pointers, and sizes: of a brick, of the coarse level, W, V, B, K, G and P; `coded` is whether there are codes."""

    brick: int
    nx: int
    ny: int
    nz: int
    leap: Any
    live: Any
    words: int
    stored: Any
    spans: int
    bricks: int
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
    blocks  S; block S is of nothing
    slot    (B,) int32: which block a brick has, or -1
    owner   (S,) int32: which brick a block is of, or -1
    kind    (S,) uint8: COLOURS or EXACT
    next    (1,) int64: the block that is filled next
    values  (S + 1, size) float32: density, red, green, blue of voxel (i - 1, j - 1, k - 1) of the brick at 4 ((i (b + 2) + j) (b + 2) + k);
            no-numbers for the colours of what is not stored. Where the kind is EXACT there is in the place of red which stored voxel it is as int32, or -1
    words   the same as int32
    painted (N + 1, 4) float32: what `paint` made
    absent  N
    voxels  ((b + 2)^3,) int32, room for a block's voxels
    waiting (QUEUE,) int64: where samples that are not composited yet lie in `values`
    """

    size: int
    blocks: int
    slot: Any
    owner: Any
    kind: Any
    next: Any
    values: Any
    words: Any
    painted: Any
    absent: int
    voxels: Any
    waiting: Any


@numba.njit(cache=True, inline="always", error_model="numpy")
def grid_of(packed, brick):  # type: ignore[no-untyped-def]
    """The arrays of a Packed as pointers."""
    return Grid(
        brick, packed.leap.shape[0], packed.leap.shape[1], packed.leap.shape[2], pointer(packed.leap), pointer(packed.live), packed.live.shape[1],
        pointer(packed.stored), packed.stored.shape[1], len(packed.place), pointer(packed.place), pointer(packed.brick_index),
        pointer(packed.voxel_index), pointer(packed.density), packed.sh.shape[1], len(packed.codes) > 0, pointer(packed.sh), pointer(packed.base),
        pointer(packed.base_table), pointer(packed.codes), packed.codes.shape[1], pointer(packed.palette), packed.palette.shape[1], pointer(packed.column),
    )  # fmt: skip


@numba.njit(cache=True, error_model="numpy", fastmath=LOOSE)
def basis_into(x, y, z, degree, out):  # type: ignore[no-untyped-def]
    """`efficientnerf.rendering.harmonics.basis` of one direction into (K,), or of four, given as Fours, into (K, 4)."""
    two, three, four, seven = np.float32(2), np.float32(3), np.float32(4), np.float32(7)
    xx, yy, zz = x * x, y * y, z * z
    store(out, 0, broadcast_like(_C0, x))
    if degree > 0:
        store(out, 1, y * -_C1)
        store(out, 2, z * _C1)
        store(out, 3, x * -_C1)
    if degree > 1:
        store(out, 4, x * y * _C2[0])
        store(out, 5, y * z * _C2[1])
        store(out, 6, (zz * two - xx - yy) * _C2[2])
        store(out, 7, x * z * _C2[3])
        store(out, 8, (xx - yy) * _C2[4])
    if degree > 2:
        store(out, 9, y * (xx * three - yy) * _C3[0])
        store(out, 10, x * y * z * _C3[1])
        store(out, 11, y * (zz * four - xx - yy) * _C3[2])
        store(out, 12, z * (zz * two - xx * three - yy * three) * _C3[3])
        store(out, 13, x * (zz * four - xx - yy) * _C3[4])
        store(out, 14, z * (xx - yy) * _C3[5])
        store(out, 15, x * (xx - yy * three) * _C3[6])
    if degree > 3:
        store(out, 16, x * y * (xx - yy) * _C4[0])
        store(out, 17, y * z * (xx * three - yy) * _C4[1])
        store(out, 18, x * y * (zz * seven - _ONE) * _C4[2])
        store(out, 19, y * z * (zz * seven - three) * _C4[3])
        store(out, 20, (zz * (zz * np.float32(35) - np.float32(30)) + three) * _C4[4])
        store(out, 21, x * z * (zz * seven - three) * _C4[5])
        store(out, 22, (xx - yy) * (zz * seven - _ONE) * _C4[6])
        store(out, 23, x * z * (xx - yy * three) * _C4[7])
        store(out, 24, (xx * (xx - yy * three) - yy * (xx * three - yy)) * _C4[8])


@numba.njit(cache=True, inline="always", error_model="numpy")
def _beside(owner, a, e, c, grid):  # type: ignore[no-untyped-def]
    """The brick (a, e, c) cells away from one, or B."""
    x, y, z = grid.place[3 * owner] + a, grid.place[3 * owner + 1] + e, grid.place[3 * owner + 2] + c
    other = np.int64(-1)
    if 0 <= x < grid.nx and 0 <= y < grid.ny and 0 <= z < grid.nz:
        other = np.int64(grid.brick_index[(x * grid.ny + y) * grid.nz + z])
    return other if other >= 0 else grid.bricks


@numba.njit(cache=True, inline="always", error_model="numpy")
def _voxel(owner, n, grid):  # type: ignore[no-untyped-def]
    """Which stored voxel the n-th of a brick is, or -1."""
    at = 2 * (owner * grid.spans + (n >> 6))
    bits, bit = grid.stored[at], np.int64(1) << (n & 63)
    number = grid.stored[at + 1] + popcount(bits & (bit - 1))
    return np.int32(number if bits & bit != 0 else -1)


@numba.njit(cache=True, error_model="numpy")
def _voxels_into(owner, grid, voxels):  # type: ignore[no-untyped-def]
    """Which stored voxels a block is of, or -1, into ((b + 2)^3,)."""
    brick, side = grid.brick, grid.brick + 2
    for n in range(9):
        p, q = n // 3, n % 3
        before, here, after = _beside(owner, p - 1, q - 1, -1, grid), _beside(owner, p - 1, q - 1, 0, grid), _beside(owner, p - 1, q - 1, 1, grid)
        # Rows of the block that are those neighbours': one layer where they are beside the brick.
        i0, i1 = (0, 1) if p == 0 else (1, side - 1) if p == 1 else (side - 1, side)
        j0, j1 = (0, 1) if q == 0 else (1, side - 1) if q == 1 else (side - 1, side)
        for i in range(i0, i1):
            for j in range(j0, j1):
                at = (i * side + j) * side
                row = ((i - 1 - (p - 1) * brick) * brick + j - 1 - (q - 1) * brick) * brick
                voxels[at] = _voxel(before, row + brick - 1, grid)
                voxels[at + side - 1] = _voxel(after, row, grid)
                for k in range(brick):
                    voxels[at + k + 1] = _voxel(here, row + k, grid)


@numba.njit(cache=True, inline="always", error_model="numpy", fastmath=LOOSE)
def sum_of_harmonics(n, grid, basis, lane, lanes):  # type: ignore[no-untyped-def]
    """Red, green and blue of stored voxel n before the sigmoid, seen along the direction that every `lanes`-th number of `basis` from `lane` on is of."""
    y = basis[lane]
    if grid.coded:
        table, base, code = grid.base_table, 3 * n, n * grid.groups
        r, g, b = y * table[3 * np.int64(grid.base[base])], y * table[3 * np.int64(grid.base[base + 1]) + 1], y * table[3 * np.int64(grid.base[base + 2]) + 2]
        if grid.terms > 1:
            total = scale4(basis[lanes + lane], load4(grid.palette, 4 * np.int64(grid.codes[code + grid.column[0]])))
            for k in range(1, grid.terms - 1):
                e = k * grid.entries + np.int64(grid.codes[code + grid.column[k]])
                total = add_scaled4(total, basis[(k + 1) * lanes + lane], load4(grid.palette, 4 * e))
            _, red, green, blue = unpack4(total)
            r, g, b = r + red, g + green, b + blue
    else:
        e = 3 * grid.terms * n
        r, g, b = y * grid.sh[e], y * grid.sh[e + 1], y * grid.sh[e + 2]
        for k in range(1, grid.terms):
            y = basis[k * lanes + lane]
            r += y * grid.sh[e + 3 * k]
            g += y * grid.sh[e + 3 * k + 1]
            b += y * grid.sh[e + 3 * k + 2]
    return r, g, b


@numba.njit(cache=True, inline="always", error_model="numpy", fastmath=LOOSE)
def _coded_sums(a, b, c, d, grid, basis):  # type: ignore[no-untyped-def]
    """What codes give four stored voxels above the base: (0, red, green, blue) each, as sixteen; `basis` (K, 4) is of their directions."""
    codes, total = grid.codes, zeros16()
    for k in range(grid.terms - 1):
        e, g = k * grid.entries, grid.column[k]
        total = add_scaled_gathered16(
            total, load4(basis, 4 * k + 4), grid.palette, 4 * (e + np.int64(codes[a * grid.groups + g])), 4 * (e + np.int64(codes[b * grid.groups + g])),
            4 * (e + np.int64(codes[c * grid.groups + g])), 4 * (e + np.int64(codes[d * grid.groups + g])),
        )  # fmt: skip
    return split16(total)


@numba.njit(cache=True, inline="always", error_model="numpy", fastmath=LOOSE)
def _coded_base(n, grid, scale, y):  # type: ignore[no-untyped-def]
    """Density, and red, green and blue that the base adds; y is the first harmonic."""
    table, base = grid.base_table, 3 * n
    r, g, b = table[3 * np.int64(grid.base[base])], table[3 * np.int64(grid.base[base + 1]) + 1], table[3 * np.int64(grid.base[base + 2]) + 2]
    return pack4(grid.density[n] * scale, y * r, y * g, y * b)


@numba.njit(cache=True, inline="always", error_model="numpy", fastmath=LOOSE)
def _plain(n, grid, scale, basis, lane):  # type: ignore[no-untyped-def]
    r, g, b = sum_of_harmonics(n, grid, basis, lane, 4)
    return pack4(grid.density[n] * scale, r, g, b)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _toward(x, y, z, toward):  # type: ignore[no-untyped-def]
    """The direction, of any length, along which a point is seen; see `View`."""
    return (
        toward[0] * x + toward[1] * y + toward[2] * z + toward[3],
        toward[4] * x + toward[5] * y + toward[6] * z + toward[7],
        toward[8] * x + toward[9] * y + toward[10] * z + toward[11],
    )


@numba.njit(cache=True, error_model="numpy", fastmath=LOOSE)
def _paint(owner, grid, view, steps, stored, basis, painted):  # type: ignore[no-untyped-def]
    """Densities and colours of a brick's voxels, four at a time, into (N, 4).

    steps   (b^3, 3) float32: see `_steps_into`
    stored  (b^3 + 3,) int64, room for a list of voxels
    basis   (K, 4) float32, room for harmonics
    """
    brick, place, index, count = grid.brick, grid.place, grid.voxel_index, 0
    first = owner * brick * brick * brick
    for local in range(brick * brick * brick):
        stored[count] = local
        count += index[first + local] >= 0
    for n in range(count, count + 3):  # the last four may be fewer, and some of them the same
        stored[n] = stored[max(count - 1, 0)]
    x, y, z = _toward(place[3 * owner] * brick + 0.5, place[3 * owner + 1] * brick + 0.5, place[3 * owner + 2] * brick + 0.5, view.toward)
    for n in range(0, count, 4):
        i, j, k, l = stored[n], stored[n + 1], stored[n + 2], stored[n + 3]
        dx = pack4(steps[3 * i], steps[3 * j], steps[3 * k], steps[3 * l]) + np.float32(x)
        dy = pack4(steps[3 * i + 1], steps[3 * j + 1], steps[3 * k + 1], steps[3 * l + 1]) + np.float32(y)
        dz = pack4(steps[3 * i + 2], steps[3 * j + 2], steps[3 * k + 2], steps[3 * l + 2]) + np.float32(z)
        share = rsqrt4(dx * dx + dy * dy + dz * dz)
        basis_into(dx * share, dy * share, dz * share, view.degree, basis)
        a, b, c, d = np.int64(index[first + i]), np.int64(index[first + j]), np.int64(index[first + k]), np.int64(index[first + l])
        if grid.coded:
            one, two, three, four = _coded_sums(a, b, c, d, grid, basis)
            store4(painted, 4 * a, one + _coded_base(a, grid, view.scale, basis[0]))
            store4(painted, 4 * b, two + _coded_base(b, grid, view.scale, basis[0]))
            store4(painted, 4 * c, three + _coded_base(c, grid, view.scale, basis[0]))
            store4(painted, 4 * d, four + _coded_base(d, grid, view.scale, basis[0]))
        else:
            store4(painted, 4 * a, _plain(a, grid, view.scale, basis, 0))
            store4(painted, 4 * b, _plain(b, grid, view.scale, basis, 1))
            store4(painted, 4 * c, _plain(c, grid, view.scale, basis, 2))
            store4(painted, 4 * d, _plain(d, grid, view.scale, basis, 3))


@numba.njit(cache=True, error_model="numpy")
def _steps_into(brick, toward, out):  # type: ignore[no-untyped-def]
    """What the direction to a voxel of a brick differs by from that to the brick's first, see `View`, into (b^3, 3)."""
    for n in range(brick * brick * brick):
        i, j, k = n // (brick * brick), n // brick % brick, n % brick
        for m in range(3):
            out[3 * n + m] = toward[4 * m] * i + toward[4 * m + 1] * j + toward[4 * m + 2] * k


@numba.njit(cache=True, parallel=True, error_model="numpy")
def paint(packed, brick, toward, scale, degree, out):  # type: ignore[no-untyped-def]
    """Density and colour of each stored voxel, as it is seen along `toward` (see `View`), into (N + 1, 4); the last is of what is not stored."""
    bricks, cube = len(packed.place), brick * brick * brick
    out[len(out) - 1, 0] = 0
    out[len(out) - 1, 1:] = np.nan
    for part in numba.prange((bricks + BRICKS - 1) // BRICKS):
        steps, stored, basis = np.empty(3 * cube, np.float32), np.empty(cube + 3, np.int64), np.empty(128, np.float32)
        grid, view = grid_of(packed, brick), View(pointer(toward), 0.0, 0.0, scale, degree)
        _steps_into(brick, view.toward, pointer(steps))
        for owner in range(BRICKS * part, min(bricks, BRICKS * part + BRICKS)):
            _paint(owner, grid, view, pointer(steps), pointer(stored), pointer(basis), pointer(out))


@numba.njit(cache=True, inline="always", error_model="numpy")
def _waits(slot, pool):  # type: ignore[no-untyped-def]
    """Whether a sample in the queue lies in a block."""
    found = False
    for n in range(QUEUE):
        found = found or pool.waiting[n] // pool.size == slot
    return found


@numba.njit(cache=True, error_model="numpy")
def fill(owner, grid, view, pool):  # type: ignore[no-untyped-def]
    """Gives a brick a block; which one. It holds colours where these are true of all samples in it."""
    slot = pool.next[0]
    while _waits(slot, pool):
        slot = (slot + 1) % pool.blocks
    pool.next[0] = (slot + 1) % pool.blocks
    before = pool.owner[slot]
    if before >= 0:
        pool.slot[before] = -1
    pool.slot[owner], pool.owner[slot] = slot, owner
    half = 0.5 * grid.brick
    x, y, z = grid.place[3 * owner] * grid.brick + half, grid.place[3 * owner + 1] * grid.brick + half, grid.place[3 * owner + 2] * grid.brick + half
    dx, dy, dz = _toward(x, y, z, view.toward)
    begin, voxels = slot * pool.size, pool.size // 4
    _voxels_into(owner, grid, pool.voxels)
    # What is looked up lies far away: without branches, waiting for one voxel does not keep from asking for the next.
    if np.sqrt(dx * dx + dy * dy + dz * dz) >= view.stretch * (view.nearest + 2 * grid.brick + 4):
        pool.kind[slot] = COLOURS
        for n in range(voxels):
            voxel = np.int64(pool.voxels[n])
            store4(pool.values, begin + 4 * n, load4(pool.painted, 4 * (voxel if voxel >= 0 else pool.absent)))
    else:
        pool.kind[slot] = EXACT
        for n in range(voxels):
            voxel = pool.voxels[n]
            pool.values[begin + 4 * n] = grid.density[max(voxel, np.int32(0))] * (view.scale if voxel >= 0 else np.float32(0))
            pool.words[begin + 4 * n + 1] = voxel
    return slot
