"""Colours of a packed tree's voxels as one camera sees them (numba, all cores).

All rays of an image pass the camera's centre, so each voxel is seen along one direction: its spherical harmonics are summed once, before the first ray, and
not at every sample. Voxels are visited in memory order.

B bricks, N stored voxels, K harmonics; b = brick.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.simd import (
    add_scaled4,
    advanced,
    broadcast_like,
    load4,
    pack4,
    pointer,
    scale4,
    store,
    unpack4,
)
from efficientnerf.backends.numba.tree.packets.halves import store_halves4
from efficientnerf.backends.numba.tree.packets.lanes import broadcast16, load16, prefetch, sqrt16
from efficientnerf.backends.numba.tree.packets.layout import MOST_HARMONICS
from efficientnerf.backends.numba.tree.packets.rows import row_at
from efficientnerf.rendering import harmonics

BRICKS_PER_TASK = 256
AHEAD = 3  # bricks whose voxels are asked for before they are needed: docs/experiments/renderer.md

_ONE = np.float32(1)
_C0 = np.float32(harmonics.C0)
_C1 = np.float32(harmonics.C1)
_C2 = tuple(np.float32(c) for c in harmonics.C2)
_C3 = tuple(np.float32(c) for c in harmonics.C3)
_C4 = tuple(np.float32(c) for c in harmonics.C4)


class View(NamedTuple):
    """What of a view its voxels' colours depend on.

    direction       12 numbers, (3, 4): maps a point (x, y, z, 1), voxel coordinates, to the direction along which it is seen, of any length, in the
                    harmonics' frame
    direction_rate  change of that direction per voxel, at most
    min_distance    voxels from the point whose direction is zero, on the scale of `direction_rate`, within which a voxel's direction differs too much from that
                    of the samples beside it: harmonics are summed at each of them. Infinity where rays have no common point, minus infinity
                    where no voxel is so near.
    density_scale   float32 factor of densities
    step            distance between samples, voxels
    degree          of the harmonics
    """

    direction: Any
    direction_rate: float
    min_distance: float
    density_scale: np.float32
    step: float
    degree: int


class Views(NamedTuple):
    """A View of each cascade: direction (L, 3, 4), min_distance (L,), density_scale (L,) float32; the rest is common to all."""

    direction: np.ndarray
    direction_rate: float
    min_distance: np.ndarray
    density_scale: np.ndarray
    step: float
    degree: int


class PackedPointers(NamedTuple):
    """One cascade of a `Packed`, with its arrays as pointers, and its sizes: cells along each axis, mask words of a block, stored voxels of all
    cascades, harmonics, code groups and palette entries; `coded` is whether there are codes, `narrow` whether a row is one number.

    ratio  of its voxels' side to that of cascade 0
    shift  x, y, z: a point of cascade 0 is here at p / ratio + shift, voxel coordinates
    """

    brick: int
    nx: int
    ny: int
    nz: int
    ratio: float
    shift_x: float
    shift_y: float
    shift_z: float
    leap: Any
    has_density: Any
    mask_words: int
    rows: Any
    narrow: bool
    voxels: int
    voxel_of: Any
    cells: Any
    brick_index: Any
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
    code_columns: Any


@numba.njit(cache=True, inline="always", error_model="numpy")
def packed_pointers(packed, brick, cascade):  # type: ignore[no-untyped-def]
    """See `PackedPointers`."""
    grids, places = packed.grids, packed.places
    first = grids[cascade, 3]
    return PackedPointers(
        brick, grids[cascade, 0], grids[cascade, 1], grids[cascade, 2], places[cascade, 0], places[cascade, 1], places[cascade, 2], places[cascade, 3],
        advanced(pointer(packed.leap), first), pointer(packed.has_density.view(np.int32)), packed.has_density.shape[1], pointer(packed.rows),
        packed.rows.shape[1] == (brick + 2) * (brick + 2), len(packed.voxel_of) - 1, pointer(packed.voxel_of), pointer(packed.cells),
        advanced(pointer(packed.brick_index), first), pointer(packed.density), packed.sh.shape[1], len(packed.codes) > 0, pointer(packed.sh),
        pointer(packed.base), pointer(packed.base_table), pointer(packed.codes), packed.codes.shape[1], pointer(packed.palette), packed.palette.shape[1],
        pointer(packed.code_columns),
    )  # fmt: skip


@numba.njit(cache=True, error_model="numpy")
def sh_basis(x, y, z, degree, out):  # type: ignore[no-untyped-def]
    """`efficientnerf.rendering.harmonics.basis` of one direction into (K,), or of four, given as Float32x4, into (K, 4)."""
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
def sh_colour(n, grid, basis, lane, lanes):  # type: ignore[no-untyped-def]
    """Red, green and blue of stored voxel n before the sigmoid; the harmonics of the direction are basis[lane :: lanes]."""
    y = basis[lane]
    if grid.coded:
        table, base, code = grid.base_table, 3 * n, n * grid.groups
        r, g, b = y * table[3 * np.int64(grid.base[base])], y * table[3 * np.int64(grid.base[base + 1]) + 1], y * table[3 * np.int64(grid.base[base + 2]) + 2]
        if grid.terms > 1:
            total = scale4(basis[lanes + lane], load4(grid.palette, 4 * np.int64(grid.codes[code + grid.code_columns[0]])))
            for k in range(1, grid.terms - 1):
                e = k * grid.entries + np.int64(grid.codes[code + grid.code_columns[k]])
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


@numba.njit(cache=True, inline="always", error_model="numpy")
def _add_entries(count, entries, total, code, grid, basis, lane):  # type: ignore[no-untyped-def]
    """The sum over `count` harmonics, each with a code of its own, of palettes of so many entries: constants, by which the loop is unrolled."""
    for k in range(count):
        total = add_scaled4(total, basis[16 * k + 16 + lane], load4(grid.palette, 4 * (k * entries + np.int64(grid.codes[code + k]))))
    return total


@numba.njit(cache=True, inline="always", error_model="numpy")
def _palette_colour(n, density, grid, basis, lane):  # type: ignore[no-untyped-def]
    """Density, red, green and blue of stored voxel n by its codes; `basis` (K, 16) is of sixteen directions, that of `lane` its own."""
    table, base, code, y = grid.base_table, 3 * n, n * grid.groups, basis[lane]
    r, g, b = table[3 * np.int64(grid.base[base])], table[3 * np.int64(grid.base[base + 1]) + 1], table[3 * np.int64(grid.base[base + 2]) + 2]
    total = pack4(density, y * r, y * g, y * b)
    if grid.terms == 9 and grid.groups == 8 and grid.entries == 256:
        return _add_entries(8, 256, total, code, grid, basis, lane)
    for k in range(grid.terms - 1):
        e = k * grid.entries + np.int64(grid.codes[code + grid.code_columns[k]])
        total = add_scaled4(total, basis[16 * k + 16 + lane], load4(grid.palette, 4 * e))
    return total


@numba.njit(cache=True, inline="always", error_model="numpy")
def view_direction(x, y, z, direction):  # type: ignore[no-untyped-def]
    """Direction, of any length, along which a point (x, y, z), voxel coordinates, is seen; see `View`."""
    return (
        direction[0] * x + direction[1] * y + direction[2] * z + direction[3],
        direction[4] * x + direction[5] * y + direction[6] * z + direction[7],
        direction[8] * x + direction[9] * y + direction[10] * z + direction[11],
    )


@numba.njit(cache=True, inline="always", error_model="numpy")
def _stored_voxels(owner, grid, stored, place):  # type: ignore[no-untyped-def]
    """Which voxels of a brick are stored, and their places in the packed order; returns their number."""
    brick, count = grid.brick, 0
    side, mask = brick + 2, (np.int64(1) << grid.brick) - 1
    for i in range(brick):
        for j in range(brick):
            first, bits = row_at((owner * side + i + 1) * side + j + 1, grid)
            local, first, bits = (i * brick + j) * brick, first + (bits & 1), bits >> 1 & mask
            for k in range(brick):
                stored[count], place[count] = local + k, first
                count, first = count + (bits >> k & 1), first + (bits >> k & 1)
    return count


@numba.njit(cache=True, inline="always", error_model="numpy")
def _prefetch_voxels(owner, grid, out):  # type: ignore[no-untyped-def]
    """Asks for what is read and written of a brick's voxels in the packed order, where rows lie too far apart for the processor to see what comes next."""
    brick = grid.brick
    side = brick + 2
    for i in range(brick):
        for j in range(brick):
            first, _ = row_at((owner * side + i + 1) * side + j + 1, grid)
            prefetch(grid.density, first)
            prefetch(grid.voxel_of, first)
            prefetch(out, 4 * first)


@numba.njit(cache=True, error_model="numpy")
def _brick_colours(owner, grid, view, steps, stored, place, basis, out):  # type: ignore[no-untyped-def]
    """Densities and colours of a brick's voxels into their rows of out (N, 4), half floats; directions and harmonics are those of sixteen neighbours at once.

    steps   (3, G, 16) float32: see `_voxel_steps`
    stored  (b^3,) int64, scratch, and place likewise
    basis   (K, 16) float32, scratch
    """
    brick, cells = grid.brick, grid.cells
    cube = brick * brick * brick
    padded, group = (cube + 15) // 16 * 16, np.int64(-1)
    count = _stored_voxels(owner, grid, stored, place)
    x, y, z = view_direction(cells[3 * owner] * brick + 0.5, cells[3 * owner + 1] * brick + 0.5, cells[3 * owner + 2] * brick + 0.5, view.direction)
    for n in range(count):
        local, p = stored[n], place[n]
        if local >> 4 != group:
            group = local >> 4
            dx, dy = load16(steps, 16 * group) + np.float32(x), load16(steps, padded + 16 * group) + np.float32(y)
            dz = load16(steps, 2 * padded + 16 * group) + np.float32(z)
            inverse = broadcast16(_ONE) / sqrt16(dx * dx + dy * dy + dz * dz)
            sh_basis(dx * inverse, dy * inverse, dz * inverse, view.degree, basis)
        voxel, lane, density = np.int64(grid.voxel_of[p]), local & 15, grid.density[p] * view.density_scale
        if grid.coded:
            store_halves4(out, 4 * p, _palette_colour(voxel, density, grid, basis, lane))
        else:
            r, g, b = sh_colour(voxel, grid, basis, lane, 16)
            store_halves4(out, 4 * p, pack4(density, r, g, b))


@numba.njit(cache=True, error_model="numpy")
def _voxel_steps(brick, direction, out):  # type: ignore[no-untyped-def]
    """Difference of the view direction of each voxel of a brick to that of the brick's first, see `View`, into (3, G, 16), of G groups of sixteen voxels."""
    cube = brick * brick * brick
    padded = (cube + 15) // 16 * 16
    for n in range(cube):
        i, j, k = n // (brick * brick), n // brick % brick, n % brick
        for m in range(3):
            out[m * padded + n] = direction[4 * m] * i + direction[4 * m + 1] * j + direction[4 * m + 2] * k


@numba.njit(cache=True, parallel=True, error_model="numpy")
def compute_view_colours(first, end, cascade, packed, brick, direction, cone, density_scale, degree, out):  # type: ignore[no-untyped-def]
    """Scaled density, and red, green and blue before the sigmoid, along `direction` (see `View`), of the voxels of bricks first <= B < end, all of one cascade,
    into out (N + 1, 4) uint16, the bits of half floats, in the packed order.

    cone  (5,) axis, cosine and sine of the half angle of a cone round all that is seen, in the frame of directions: bricks that are farther from it than any
          whose voxels a ray or its normal may need are left out. Zeros: none are

    The last row, of voxels that are not stored, is for the caller to fill with zeros.
    """
    cube = brick * brick * brick
    for task in numba.prange((end - first + BRICKS_PER_TASK - 1) // BRICKS_PER_TASK):
        steps, stored, basis = np.zeros(3 * (cube + 15), np.float32), np.empty((2, cube), np.int64), np.empty(16 * MOST_HARMONICS, np.float32)
        grid, view = packed_pointers(packed, brick, cascade), View(pointer(direction), 0.0, 0.0, density_scale, 0.0, degree)
        _voxel_steps(brick, view.direction, pointer(steps))
        # From a ray to a normal's block one voxel, through that block and to the middle of the brick beside it; and one for rounding.
        half, reach = 0.5 * brick, np.sqrt(3.0) * (1.5 * brick + 1) + 2
        for owner in range(first + BRICKS_PER_TASK * task, min(end, first + BRICKS_PER_TASK * task + BRICKS_PER_TASK)):
            a, e, c = grid.cells[3 * owner] * brick + half, grid.cells[3 * owner + 1] * brick + half, grid.cells[3 * owner + 2] * brick + half
            x, y, z = view_direction(a, e, c, view.direction)
            along = x * cone[0] + y * cone[1] + z * cone[2]
            if owner + AHEAD < end:
                _prefetch_voxels(owner + AHEAD, grid, pointer(out))
            if np.sqrt(max(x * x + y * y + z * z - along * along, 0.0)) * cone[3] - along * cone[4] <= reach:
                _brick_colours(owner, grid, view, pointer(steps), pointer(stored[0]), pointer(stored[1]), pointer(basis), pointer(out))
