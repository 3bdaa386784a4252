"""Marching rays through a packed tree (numba): what a ray sees, and what a picture's pixels see.

numba's cache looks at the file of the kernel that is called, not at those of the functions written into it: whoever changes this file deletes
`__pycache__` beside it, or sees the old march.

Every ray samples at t = t_enter + (k + 1/2) * step, step = half a voxel, whatever it skips, so that skipping empty space changes no value.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from efficientnerf import harmonics

STEP = 0.5  # of a voxel
STOP = 1e-3  # transmittance at which a ray ends
FAINT = 1e-4  # weight under which a sample's colour is not looked up; the next one that is looked up stands for it

# Sums may be taken in any order and products fused; infinities and no-numbers keep their meaning.
LOOSE = {"contract", "reassoc", "arcp", "nsz"}
ROUNDING = 1e-3  # of a step: a skip that is computed in float32 ends so much early, for it must never end late

_HALF, _ONE = np.float32(0.5), np.float32(1)
_C0 = np.float32(harmonics.C0)
_C1 = np.float32(harmonics.C1)
_C2 = tuple(np.float32(c) for c in harmonics.C2)
_C3 = tuple(np.float32(c) for c in harmonics.C3)
_C4 = tuple(np.float32(c) for c in harmonics.C4)
_LOGISTIC_REACH, _LOGISTIC_PER_UNIT = 16, 64
_LOGISTIC = (1 / (1 + np.exp(-np.linspace(-_LOGISTIC_REACH, _LOGISTIC_REACH, 2 * _LOGISTIC_REACH * _LOGISTIC_PER_UNIT + 1)))).astype(np.float32)
_LOG2E = np.float32(math.log2(math.e))
# 2^-f = 1 + f (c_0 + f (c_1 + ...)) for f from 0 to 1, to 6e-8: least largest error among those that are 1 at 0.
_EXP2 = tuple(np.float32(c) for c in (-0.69314442, 0.24018671, -0.05531669, 0.00922838, -0.00095403))


@numba.njit(cache=True, inline="always", error_model="numpy", fastmath=LOOSE)
def _exp_minus(x):  # type: ignore[no-untyped-def]
    """exp(-x) for float32 x >= 0."""
    y = min(x * _LOG2E, np.float32(126))
    whole = np.int32(y)
    f = y - np.float32(whole)
    p = _ONE + f * (_EXP2[0] + f * (_EXP2[1] + f * (_EXP2[2] + f * (_EXP2[3] + f * _EXP2[4]))))
    return p * np.int32((np.int32(127) - whole) << np.int32(23)).view(np.float32)


@numba.njit(cache=True, error_model="numpy", fastmath=LOOSE)
def _harmonics(x, y, z, degree, out):  # type: ignore[no-untyped-def]
    """`efficientnerf.harmonics.basis` of one direction, thrice in (3, P): row c holds Y_k at 3 k + c and zeros elsewhere."""
    two, three, four, seven = np.float32(2), np.float32(3), np.float32(4), np.float32(7)
    xx, yy, zz = x * x, y * y, z * z
    row = out[0]
    row[0] = _C0
    if degree > 0:
        row[3], row[6], row[9] = -_C1 * y, _C1 * z, -_C1 * x
    if degree > 1:
        row[12], row[15], row[18] = _C2[0] * x * y, _C2[1] * y * z, _C2[2] * (two * zz - xx - yy)
        row[21], row[24] = _C2[3] * x * z, _C2[4] * (xx - yy)
    if degree > 2:
        row[27], row[30], row[33] = _C3[0] * y * (three * xx - yy), _C3[1] * x * y * z, _C3[2] * y * (four * zz - xx - yy)
        row[36] = _C3[3] * z * (two * zz - three * xx - three * yy)
        row[39], row[42], row[45] = _C3[4] * x * (four * zz - xx - yy), _C3[5] * z * (xx - yy), _C3[6] * x * (xx - three * yy)
    if degree > 3:
        row[48], row[51] = _C4[0] * x * y * (xx - yy), _C4[1] * y * z * (three * xx - yy)
        row[54], row[57] = _C4[2] * x * y * (seven * zz - _ONE), _C4[3] * y * z * (seven * zz - three)
        row[60] = _C4[4] * (zz * (np.float32(35) * zz - np.float32(30)) + three)
        row[63], row[66] = _C4[5] * x * z * (seven * zz - three), _C4[6] * (xx - yy) * (seven * zz - _ONE)
        row[69], row[72] = _C4[7] * x * z * (xx - three * yy), _C4[8] * (xx * (xx - three * yy) - yy * (three * xx - yy))
    for k in range((degree + 1) ** 2):
        out[1, 3 * k + 1] = row[3 * k]
        out[2, 3 * k + 2] = row[3 * k]


@numba.njit(cache=True, inline="always", error_model="numpy", fastmath=LOOSE)
def _trilinear(block, at, j, i, fx, fy, fz):  # type: ignore[no-untyped-def]
    """Interpolates the eight values from `at`; j and i are the strides of y and x."""
    # Unsigned, for a signed index might be one that counts from the end, which would be tested at every read.
    at, i, j, one = np.uint64(at), np.uint64(i), np.uint64(j), np.uint64(1)
    a = block[at] + fz * (block[at + one] - block[at])
    b = block[at + j] + fz * (block[at + j + one] - block[at + j])
    c = block[at + i] + fz * (block[at + i + one] - block[at + i])
    d = block[at + i + j] + fz * (block[at + i + j + one] - block[at + i + j])
    e = a + fy * (b - a)
    return e + fx * (c + fy * (d - c) - e)


@numba.njit(cache=True, inline="always", error_model="numpy", fastmath=LOOSE)
def _logistic(x):  # type: ignore[no-untyped-def]
    """1 / (1 + exp(-x)) to 3e-6."""
    at = min(max((x + np.float32(_LOGISTIC_REACH)) * np.float32(_LOGISTIC_PER_UNIT), np.float32(0)), np.float32(len(_LOGISTIC) - 1.001))
    i = int(at)
    return _LOGISTIC[i] + (at - np.float32(i)) * (_LOGISTIC[i + 1] - _LOGISTIC[i])


@numba.njit(cache=True, error_model="numpy", fastmath=LOOSE)
def _colour_of_rows(voxel, at, j, i, fx, fy, fz, sh, scale, basis):  # type: ignore[no-untyped-def]
    """Red, green, blue at a point: coefficients interpolated over the voxels that are stored.

    voxel, at, j, i  rows of a brick's block, the low corner in it, strides of y and x
    """
    none = sh.shape[0] - 1
    n0, n1, n2, n3 = voxel[at], voxel[at + 1], voxel[at + j], voxel[at + j + 1]
    n4, n5, n6, n7 = voxel[at + i], voxel[at + i + 1], voxel[at + i + j], voxel[at + i + j + 1]
    gx, gy, gz = _ONE - fx, _ONE - fy, _ONE - fz
    w0, w1, w2, w3 = gx * gy * gz, gx * gy * fz, gx * fy * gz, gx * fy * fz
    w4, w5, w6, w7 = fx * gy * gz, fx * gy * fz, fx * fy * gz, fx * fy * fz
    total = _ONE
    if n0 == none or n1 == none or n2 == none or n3 == none or n4 == none or n5 == none or n6 == none or n7 == none:
        zero = np.float32(0)
        total = (w0 if n0 != none else zero) + (w1 if n1 != none else zero) + (w2 if n2 != none else zero) + (w3 if n3 != none else zero)
        total += (w4 if n4 != none else zero) + (w5 if n5 != none else zero) + (w6 if n6 != none else zero) + (w7 if n7 != none else zero)
    w0, w1, w2, w3 = w0 * scale[n0], w1 * scale[n1], w2 * scale[n2], w3 * scale[n3]
    w4, w5, w6, w7 = w4 * scale[n4], w5 * scale[n5], w6 * scale[n6], w7 * scale[n7]
    r = g = b = np.float32(0)
    for p in range(sh.shape[1]):
        mixed = w0 * np.float32(sh[n0, p]) + w1 * np.float32(sh[n1, p]) + w2 * np.float32(sh[n2, p]) + w3 * np.float32(sh[n3, p])
        mixed += w4 * np.float32(sh[n4, p]) + w5 * np.float32(sh[n5, p]) + w6 * np.float32(sh[n6, p]) + w7 * np.float32(sh[n7, p])
        r += mixed * basis[0, p]
        g += mixed * basis[1, p]
        b += mixed * basis[2, p]
    if total > 0:
        share = _ONE / total
        r, g, b = r * share, g * share, b * share
    return _logistic(r), _logistic(g), _logistic(b)


@numba.njit(cache=True, inline="always", error_model="numpy", fastmath=LOOSE)
def _corner(around, neighbour, voxel, at, share):  # type: ignore[no-untyped-def]
    """A voxel and its weight: 0 and 0 where none is stored."""
    there = around[np.uint64(neighbour)]
    stored = voxel[np.uint64(max(there, 0)), np.uint64(at)]
    known = (there | stored) >= 0
    return np.uint64(stored if known else 0), share if known else np.float32(0)


@numba.njit(cache=True, inline="always", error_model="numpy", fastmath=LOOSE)
def _corners(i, j, k, fx, fy, fz, brick, around, voxel):  # type: ignore[no-untyped-def]
    """The eight voxels of an interpolation and their weights, which add up to 1 over those that are stored; others have weight 0.

    i, j, k  low corner in the block of a brick, 0 to b
    around   (27,) the bricks around it
    """
    # Along each axis: which neighbour, and which voxel of it, for the low corner and the high one.
    x0, x1 = np.int32(9 if i > 0 else 0), np.int32(18 if i == brick else 9)
    y0, y1 = np.int32(3 if j > 0 else 0), np.int32(6 if j == brick else 3)
    z0, z1 = np.int32(1 if k > 0 else 0), np.int32(2 if k == brick else 1)
    plane = brick * brick
    i0, i1 = (i - 1 if i > 0 else brick - 1) * plane, (0 if i == brick else i) * plane
    j0, j1 = (j - 1 if j > 0 else brick - 1) * brick, (0 if j == brick else j) * brick
    k0, k1 = k - 1 if k > 0 else brick - 1, 0 if k == brick else k
    gx, gy, gz = _ONE - fx, _ONE - fy, _ONE - fz
    n0, w0 = _corner(around, x0 + y0 + z0, voxel, i0 + j0 + k0, gx * gy * gz)
    n1, w1 = _corner(around, x0 + y0 + z1, voxel, i0 + j0 + k1, gx * gy * fz)
    n2, w2 = _corner(around, x0 + y1 + z0, voxel, i0 + j1 + k0, gx * fy * gz)
    n3, w3 = _corner(around, x0 + y1 + z1, voxel, i0 + j1 + k1, gx * fy * fz)
    n4, w4 = _corner(around, x1 + y0 + z0, voxel, i1 + j0 + k0, fx * gy * gz)
    n5, w5 = _corner(around, x1 + y0 + z1, voxel, i1 + j0 + k1, fx * gy * fz)
    n6, w6 = _corner(around, x1 + y1 + z0, voxel, i1 + j1 + k0, fx * fy * gz)
    n7, w7 = _corner(around, x1 + y1 + z1, voxel, i1 + j1 + k1, fx * fy * fz)
    total = ((w0 + w1) + (w2 + w3)) + ((w4 + w5) + (w6 + w7))
    share = _ONE / total if total > 0 else _ONE
    return (n0, n1, n2, n3, n4, n5, n6, n7), (w0 * share, w1 * share, w2 * share, w3 * share, w4 * share, w5 * share, w6 * share, w7 * share)


@numba.njit(cache=True, error_model="numpy", fastmath=LOOSE)
def _colour_of_codes(i, j, k, fx, fy, fz, brick, around, voxel, base, table, codes, palette, column, basis):  # type: ignore[no-untyped-def]
    """The same where voxels are codes into palettes; i, j, k: low corner in the block."""
    index, weight = _corners(i, j, k, fx, fy, fz, brick, around, voxel)
    n0, n1, n2, n3, n4, n5, n6, n7 = index
    w0, w1, w2, w3, w4, w5, w6, w7 = weight
    r = w0 * table[base[n0, 0], 0] + w1 * table[base[n1, 0], 0] + w2 * table[base[n2, 0], 0] + w3 * table[base[n3, 0], 0]
    r += w4 * table[base[n4, 0], 0] + w5 * table[base[n5, 0], 0] + w6 * table[base[n6, 0], 0] + w7 * table[base[n7, 0], 0]
    g = w0 * table[base[n0, 1], 1] + w1 * table[base[n1, 1], 1] + w2 * table[base[n2, 1], 1] + w3 * table[base[n3, 1], 1]
    g += w4 * table[base[n4, 1], 1] + w5 * table[base[n5, 1], 1] + w6 * table[base[n6, 1], 1] + w7 * table[base[n7, 1], 1]
    b = w0 * table[base[n0, 2], 2] + w1 * table[base[n1, 2], 2] + w2 * table[base[n2, 2], 2] + w3 * table[base[n3, 2], 2]
    b += w4 * table[base[n4, 2], 2] + w5 * table[base[n5, 2], 2] + w6 * table[base[n6, 2], 2] + w7 * table[base[n7, 2], 2]
    r, g, b = r * basis[0, 0], g * basis[0, 0], b * basis[0, 0]
    for k in range(len(column)):
        at, y = np.uint64(column[k]), basis[0, 3 * k + 3]
        e0, e1, e2, e3 = codes[n0, at], codes[n1, at], codes[n2, at], codes[n3, at]
        e4, e5, e6, e7 = codes[n4, at], codes[n5, at], codes[n6, at], codes[n7, at]
        x = w0 * palette[e0, k, 0] + w1 * palette[e1, k, 0] + w2 * palette[e2, k, 0] + w3 * palette[e3, k, 0]
        r += y * (x + w4 * palette[e4, k, 0] + w5 * palette[e5, k, 0] + w6 * palette[e6, k, 0] + w7 * palette[e7, k, 0])
        x = w0 * palette[e0, k, 1] + w1 * palette[e1, k, 1] + w2 * palette[e2, k, 1] + w3 * palette[e3, k, 1]
        g += y * (x + w4 * palette[e4, k, 1] + w5 * palette[e5, k, 1] + w6 * palette[e6, k, 1] + w7 * palette[e7, k, 1])
        x = w0 * palette[e0, k, 2] + w1 * palette[e1, k, 2] + w2 * palette[e2, k, 2] + w3 * palette[e3, k, 2]
        b += y * (x + w4 * palette[e4, k, 2] + w5 * palette[e5, k, 2] + w6 * palette[e6, k, 2] + w7 * palette[e7, k, 2])
    return _logistic(r), _logistic(g), _logistic(b)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _density(u, v, w, brick, cell, density):  # type: ignore[no-untyped-def]
    """Density at a point in voxel coordinates, float32; 0 outside of the grid and in an empty cell."""
    if not (0 <= u < cell.shape[0] * brick and 0 <= v < cell.shape[1] * brick and 0 <= w < cell.shape[2] * brick):
        return np.float32(0)
    a, e, c = int(u) // brick, int(v) // brick, int(w) // brick
    owner = cell[a, e, c]
    if owner < 0:
        return np.float32(0)
    x, y, z = u - np.float32(a * brick) + _HALF, v - np.float32(e * brick) + _HALF, w - np.float32(c * brick) + _HALF
    i, j, k = int(x), int(y), int(z)
    side = brick + 2
    return _trilinear(density[owner], (i * side + j) * side + k, side, side * side, x - np.float32(i), y - np.float32(j), z - np.float32(k))


@numba.njit(cache=True, error_model="numpy")
def normal_into(u, v, w, brick, cell, density, out):  # type: ignore[no-untyped-def]
    """Unit normal (down the gradient, central differences of one voxel) into `out`; zero where the density is flat."""
    gx = _density(u + _ONE, v, w, brick, cell, density) - _density(u - _ONE, v, w, brick, cell, density)
    gy = _density(u, v + _ONE, w, brick, cell, density) - _density(u, v - _ONE, w, brick, cell, density)
    gz = _density(u, v, w + _ONE, brick, cell, density) - _density(u, v, w - _ONE, brick, cell, density)
    length = np.sqrt(gx * gx + gy * gy + gz * gz)
    if length > 0:
        out[0], out[1], out[2] = -gx / length, -gy / length, -gz / length
    else:
        out[0] = out[1] = out[2] = np.float32(0)


@numba.njit(cache=True, error_model="numpy", fastmath=LOOSE)
def march(ex, ey, ez, dx, dy, dz, k, last, reach, brick, grid, looking, degree, basis, out):  # type: ignore[no-untyped-def]
    """What lies on a ray from its k-th to its last-th sample.

    ex, ey, ez, dx, dy, dz  float32: where it enters the box, voxel coordinates, and its unit direction
    reach                   float32: length of a step, world units
    looking                 (3,) float32: the direction that the harmonics are asked for
    basis                   (3, P) float32, room for the harmonics: zeros where they never are
    out                     (9,) float32: red, green, blue, opacity; where half of the light is gone, voxels from the entry, or infinity; and what it took:
                            cells looked at, samples tested, samples interpolated, colours looked up
    """
    cell, density = grid.cell, grid.density
    side = brick + 2
    plane = side * side
    step, width, per_brick = np.float32(STEP), np.float32(brick), np.float32(1 / brick)
    big = np.float32(1e30)
    # The parameter at which a face at x is crossed: x * slope + shift; never, along an axis that the ray does not move on.
    slope_x, slope_y, slope_z = (_ONE / dx if dx != 0 else 0), (_ONE / dy if dy != 0 else 0), (_ONE / dz if dz != 0 else 0)
    coded = len(grid.codes) > 0
    light, owed = _ONE, np.float32(0)
    red = green = blue = np.float32(0)
    hit = np.float32(np.inf)
    cells = tested = mixed = colours = 0
    while k < last:
        s = (np.float32(k) + _HALF) * step
        u, v, w = ex + s * dx, ey + s * dy, ez + s * dz
        a = min(max(int(u * per_brick), 0), cell.shape[0] - 1)
        e = min(max(int(v * per_brick), 0), cell.shape[1] - 1)
        c = min(max(int(w * per_brick), 0), cell.shape[2] - 1)
        owner = cell[a, e, c]
        cells += 1
        far = 1 if owner >= 0 else -1 - owner
        # To the end of the cell, or of the empty cube round it: the nearest of its three far faces.
        x = np.float32(a + far if dx > 0 else a - far + 1) * width
        y = np.float32(e + far if dy > 0 else e - far + 1) * width
        z = np.float32(c + far if dz > 0 else c - far + 1) * width
        tx = (x - ex) * slope_x if dx != 0 else big
        ty = (y - ey) * slope_y if dy != 0 else big
        tz = (z - ez) * slope_z if dz != 0 else big
        end = min(min(tx, ty, tz) * np.float32(1 / STEP) - np.float32(0.5 + ROUNDING), np.float32(last))
        until = min(max(int(np.ceil(end)), k + 1), last)
        if owner < 0:
            k = until
            continue
        block = density[owner]
        tested -= k
        bx, by, bz = ex - np.float32(a) * width + _HALF, ey - np.float32(e) * width + _HALF, ez - np.float32(c) * width + _HALF
        while k < until:
            s = (np.float32(k) + _HALF) * step
            x, y, z = bx + s * dx, by + s * dy, bz + s * dz
            i, j, l = int(x), int(y), int(z)
            at = i * plane + j * side + l
            k += 1
            if np.float32(block[np.uint64(at)]).view(np.int32) < 0:
                continue
            mixed += 1
            fx, fy, fz = x - np.float32(i), y - np.float32(j), z - np.float32(l)
            sigma = _trilinear(block, at, side, plane, fx, fy, fz)
            if sigma <= 0:
                continue
            left = light * _exp_minus(sigma * reach)
            owed += light - left
            if owed > np.float32(FAINT):
                if colours == 0:
                    _harmonics(looking[0], looking[1], looking[2], degree, basis)
                colours += 1
                if coded:
                    r, g, b = _colour_of_codes(
                        i, j, l, fx, fy, fz, brick, grid.around[owner], grid.voxel, grid.base, grid.base_table, grid.codes, grid.palette, grid.column, basis
                    )
                else:
                    r, g, b = _colour_of_rows(grid.voxel[owner], at, side, plane, fx, fy, fz, grid.sh, grid.scale, basis)
                red += owed * r
                green += owed * g
                blue += owed * b
                owed = np.float32(0)
            if left <= _HALF and light > _HALF:
                hit = s - _HALF * step + np.log(2 * light) / (sigma * reach) * step
            light = left
            if light < np.float32(STOP):
                last = k
                break
        tested += k
    out[0], out[1], out[2], out[3], out[4] = red, green, blue, _ONE - light, hit
    out[5], out[6], out[7], out[8] = cells, tested, mixed, colours
