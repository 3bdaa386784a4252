"""Colours of a packed tree's voxels as one camera sees them (numba, all cores).

All rays of an image pass the camera's centre, so each voxel is seen along one direction: its spherical harmonics are summed once, before the first ray, and
not at every sample. Voxels are visited in memory order.

B bricks, N stored voxels, K harmonics; b = brick.
"""

from typing import Any, NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.tree.packets.layout import MOST_HARMONICS
from efficientnerf.backends.numba.vector.halves import store_halves
from efficientnerf.backends.numba.vector.maths import bits_of, broadcast, broadcast_like, fma, pack, sqrt, to_float32, unpack
from efficientnerf.backends.numba.vector.memory import advanced, hold, load, load_bytes8, pointer, store_nth
from efficientnerf.rendering import harmonics

VOXELS_PER_TASK = 2**14
REACH = 3.0  # voxels from a ray to the voxels around its samples, which is at most the square root of 3, and for rounding
ROUNDING = np.float32(4e-6)  # of places on the way to a voxel, for its distance
ALL = 2**16 - 1  # bits of sixteen lanes

_ONE = np.float32(1)
_C0 = np.float32(harmonics.C0)
_C1 = np.float32(harmonics.C1)
_C2 = tuple(np.float32(c) for c in harmonics.C2)
_C3 = tuple(np.float32(c) for c in harmonics.C3)
_C4 = tuple(np.float32(c) for c in harmonics.C4)


class View(NamedTuple):
    """What of a view its voxels' colours depend on; in the view of all cascades the direction, `min_distance` and `density_scale` are arrays (L, ...).

    direction       (3, 4): maps a point (x, y, z, 1), voxel coordinates, to the direction along which it is seen, of any length, in the
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
    min_distance: Any
    density_scale: Any
    step: float
    degree: int


class PackedPointers(NamedTuple):
    """One cascade of a `Packed`, with its arrays as pointers, and its sizes: cells along each axis, mask words of a block, stored voxels of all
    cascades, harmonics, code groups and palette entries; `coded` is whether there are codes, `narrow` whether a row is one number,
    `directed` whether `octants` differ from one another; else they all are `leap`.

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
    octants: Any
    directed: bool
    has_density: Any
    mask_words: int
    rows: Any
    narrow: bool
    voxels: int
    voxel_of: Any
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
def packed_pointers(packed, brick):
    """The first cascade, see `PackedPointers`."""
    grids, places = packed.grids, packed.places
    return PackedPointers(
        brick, grids[0, 0], grids[0, 1], grids[0, 2], places[0, 0], places[0, 1], places[0, 2], places[0, 3],
        pointer(packed.leap), pointer(packed.octants) if len(packed.octants) > 0 else pointer(packed.leap), len(packed.octants) > 0,
        pointer(packed.has_density.view(np.int32)), packed.has_density.shape[1], pointer(packed.rows),
        packed.rows.shape[1] == (brick + 2) * (brick + 2), len(packed.voxel_of) - 1, pointer(packed.voxel_of),
        pointer(packed.brick_index), pointer(packed.density), packed.sh.shape[1], len(packed.codes) > 0, pointer(packed.sh),
        pointer(packed.base), pointer(packed.base_table), pointer(packed.codes), packed.codes.shape[1], pointer(packed.palette), packed.palette.shape[1],
        pointer(packed.code_columns),
    )  # fmt: skip


@numba.njit(cache=True, error_model="numpy")
def sh_basis(x, y, z, degree, out):
    """`efficientnerf.rendering.harmonics.basis` of one direction into (K,), or of four, given as Float32x4, into (K, 4)."""
    two, three, four, seven = np.float32(2), np.float32(3), np.float32(4), np.float32(7)
    xx, yy, zz = x * x, y * y, z * z
    store_nth(out, 0, broadcast_like(_C0, x))
    if degree > 0:
        store_nth(out, 1, y * -_C1)
        store_nth(out, 2, z * _C1)
        store_nth(out, 3, x * -_C1)
    if degree > 1:
        store_nth(out, 4, x * y * _C2[0])
        store_nth(out, 5, y * z * _C2[1])
        store_nth(out, 6, (zz * two - xx - yy) * _C2[2])
        store_nth(out, 7, x * z * _C2[3])
        store_nth(out, 8, (xx - yy) * _C2[4])
    if degree > 2:
        store_nth(out, 9, y * (xx * three - yy) * _C3[0])
        store_nth(out, 10, x * y * z * _C3[1])
        store_nth(out, 11, y * (zz * four - xx - yy) * _C3[2])
        store_nth(out, 12, z * (zz * two - xx * three - yy * three) * _C3[3])
        store_nth(out, 13, x * (zz * four - xx - yy) * _C3[4])
        store_nth(out, 14, z * (xx - yy) * _C3[5])
        store_nth(out, 15, x * (xx - yy * three) * _C3[6])
    if degree > 3:
        store_nth(out, 16, x * y * (xx - yy) * _C4[0])
        store_nth(out, 17, y * z * (xx * three - yy) * _C4[1])
        store_nth(out, 18, x * y * (zz * seven - _ONE) * _C4[2])
        store_nth(out, 19, y * z * (zz * seven - three) * _C4[3])
        store_nth(out, 20, (zz * (zz * np.float32(35) - np.float32(30)) + three) * _C4[4])
        store_nth(out, 21, x * z * (zz * seven - three) * _C4[5])
        store_nth(out, 22, (xx - yy) * (zz * seven - _ONE) * _C4[6])
        store_nth(out, 23, x * z * (xx - yy * three) * _C4[7])
        store_nth(out, 24, (xx * (xx - yy * three) - yy * (xx * three - yy)) * _C4[8])


@numba.njit(cache=True, inline="always", error_model="numpy")
def sh_colour(n, grid, basis, lane, lanes):
    """Red, green and blue of voxel n of the packed order before the sigmoid; the harmonics of the direction are basis[lane :: lanes]."""
    y = basis[lane]
    if grid.coded:
        table, base, code = grid.base_table, 3 * n, n * grid.groups
        r, g, b = y * table[3 * np.int64(grid.base[base])], y * table[3 * np.int64(grid.base[base + 1]) + 1], y * table[3 * np.int64(grid.base[base + 2]) + 2]
        if grid.terms > 1:
            total = basis[lanes + lane] * load(grid.palette, 4 * np.int64(grid.codes[code + grid.code_columns[0]]), 4)
            for k in range(1, grid.terms - 1):
                e = k * grid.entries + np.int64(grid.codes[code + grid.code_columns[k]])
                total = fma(basis[(k + 1) * lanes + lane], load(grid.palette, 4 * e, 4), total)
            _, red, green, blue = unpack(total)
            r, g, b = r + red, g + green, b + blue
    else:
        e = 3 * grid.terms * np.int64(grid.voxel_of[n])
        r, g, b = y * grid.sh[e], y * grid.sh[e + 1], y * grid.sh[e + 2]
        for k in range(1, grid.terms):
            y = basis[k * lanes + lane]
            r += y * grid.sh[e + 3 * k]
            g += y * grid.sh[e + 3 * k + 1]
            b += y * grid.sh[e + 3 * k + 2]
    return r, g, b


@numba.njit(cache=True, error_model="numpy")
def _eight_codes(count, density, scale, base, table, codes, palette, basis, out):
    """Density, red, green and blue of `count` voxels, at most sixteen, by eight codes each into 256 entries: numbers that loops are unrolled by.

    basis  (9, 16) float32, of the direction of each
    """
    for n in range(count):
        y, eight = basis[n], load_bytes8(codes, 8 * n)
        r, g, b = table[3 * np.int64(base[3 * n])], table[3 * np.int64(base[3 * n + 1]) + 1], table[3 * np.int64(base[3 * n + 2]) + 2]
        total = pack((density[n] * scale, y * r, y * g, y * b))
        for k in range(8):
            total = fma(basis[16 * k + 16 + n], load(palette, 1024 * k + 4 * (eight >> 8 * k & 255), 4), total)
        store_halves(out, 4 * n, total)


@numba.njit(cache=True, inline="always", error_model="numpy")
def view_direction(x, y, z, direction):
    """Direction, of any length, along which a point (x, y, z), voxel coordinates, is seen; see `View`."""
    return (
        direction[0] * x + direction[1] * y + direction[2] * z + direction[3],
        direction[4] * x + direction[5] * y + direction[6] * z + direction[7],
        direction[8] * x + direction[9] * y + direction[10] * z + direction[11],
    )


@numba.njit(cache=True, error_model="numpy")
def _colours(first, end, packed, direction, cone, density_scale, degree, basis, out):
    """`compute_view_colours`, one after the other; directions and harmonics are those of sixteen voxels at once.

    basis  (K, 16) float32, scratch
    """
    grid, d, voxels = packed_pointers(packed, 1), direction, packed.coordinates.shape[1]
    at, half = pointer(packed.coordinates), 0.5
    eight = grid.coded and grid.terms == 9 and grid.groups == 8 and grid.entries == 256 and packed.codes.itemsize == 1
    # To the middle of the first voxel, and from there by whole voxels.
    x0, y0, z0 = view_direction(half, half, half, d)
    reach = np.float32(REACH * np.sqrt(d[0] * d[0] + d[4] * d[4] + d[8] * d[8]))
    ax, ay, az, cosine, sine = np.float32(cone[0]), np.float32(cone[1]), np.float32(cone[2]), np.float32(cone[3]), np.float32(cone[4])
    for begin in range(first, end, 16):
        u, v, w = to_float32(load(at, begin, 16)), to_float32(load(at, voxels + begin, 16)), to_float32(load(at, 2 * voxels + begin, 16))
        x = u * np.float32(d[0]) + v * np.float32(d[1]) + w * np.float32(d[2]) + np.float32(x0)
        y = u * np.float32(d[4]) + v * np.float32(d[5]) + w * np.float32(d[6]) + np.float32(y0)
        z = u * np.float32(d[8]) + v * np.float32(d[9]) + w * np.float32(d[10]) + np.float32(z0)
        length = sqrt(x * x + y * y + z * z)
        along = x * ax + y * ay + z * az
        p, q, r = x - along * ax, y - along * ay, z - along * az
        beside = sqrt(p * p + q * q + r * r)
        if bits_of(beside * cosine - along * sine > reach + length * ROUNDING) == ALL:
            continue
        inverse = broadcast(_ONE, 16) / length
        sh_basis(x * inverse, y * inverse, z * inverse, degree, basis)
        count = min(16, end - begin)
        if eight:
            codes, base, rgb = advanced(grid.codes, 8 * begin), advanced(grid.base, 3 * begin), advanced(out, 4 * begin)
            _eight_codes(count, advanced(grid.density, begin), density_scale, base, grid.base_table, codes, grid.palette, basis, rgb)
            continue
        for n in range(begin, begin + count):
            r, g, b = sh_colour(n, grid, basis, n - begin, 16)
            store_halves(out, 4 * n, pack((grid.density[n] * density_scale, r, g, b)))


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def compute_view_colours(first, end, packed, direction, cone, density_scale, degree, out):
    """Scaled density, and red, green and blue before the sigmoid, along `direction` (see `View`), of voxels first <= n < end of the packed order, all of one
    cascade, into out (N + 1, 4) uint16, the bits of half floats.

    cone  (5,) axis, cosine and sine of the half angle of a cone round all that is seen, in the frame of directions: voxels that are farther from it than any
          that a sample of a ray may need are left out, sixteen at a time. Zeros: none are

    The last row, of voxels that are not stored, is for the caller to fill with zeros.
    """
    for task in numba.prange((end - first + VOXELS_PER_TASK - 1) // VOXELS_PER_TASK):
        basis, begin = np.empty(16 * MOST_HARMONICS, np.float32), first + VOXELS_PER_TASK * task
        end_of_task = min(end, begin + VOXELS_PER_TASK)
        _colours(begin, end_of_task, packed, pointer(direction), pointer(cone), density_scale, degree, pointer(basis), pointer(out))
        hold((basis,))
