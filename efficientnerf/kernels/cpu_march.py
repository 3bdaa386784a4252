"""Marching rays through a packed tree (numba): what a ray sees, and what a picture's pixels see.

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
    a = block[at] + fz * (block[at + 1] - block[at])
    b = block[at + j] + fz * (block[at + j + 1] - block[at + j])
    c = block[at + i] + fz * (block[at + i + 1] - block[at + i])
    d = block[at + i + j] + fz * (block[at + i + j + 1] - block[at + i + j])
    e = a + fy * (b - a)
    return e + fx * (c + fy * (d - c) - e)


@numba.njit(cache=True, inline="always", error_model="numpy", fastmath=LOOSE)
def _logistic(x):  # type: ignore[no-untyped-def]
    """1 / (1 + exp(-x)) to 3e-6."""
    at = min(max((x + np.float32(_LOGISTIC_REACH)) * np.float32(_LOGISTIC_PER_UNIT), np.float32(0)), np.float32(len(_LOGISTIC) - 1.001))
    i = int(at)
    return _LOGISTIC[i] + (at - np.float32(i)) * (_LOGISTIC[i + 1] - _LOGISTIC[i])


@numba.njit(cache=True, error_model="numpy", fastmath=LOOSE)
def _colour(voxel, at, j, i, fx, fy, fz, sh, scale, basis):  # type: ignore[no-untyped-def]
    """Red, green, blue at a point: coefficients interpolated over the voxels that are stored."""
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
    basis                   (3, P) float32, room for the harmonics
    out                     (6,) float32: red, green, blue, opacity; where half of the light is gone, voxels from the entry, or infinity; density there
    """
    cell, density, voxel, sh, scale = grid.cell, grid.density, grid.voxel, grid.sh, grid.scale
    side = brick + 2
    plane = side * side
    step, width, per_brick = np.float32(STEP), np.float32(brick), np.float32(1 / brick)
    big = np.float32(1e30)
    # The parameter at which a face at x is crossed: x * slope + shift; never, along an axis that the ray does not move on.
    slope_x, slope_y, slope_z = (_ONE / dx if dx != 0 else 0), (_ONE / dy if dy != 0 else 0), (_ONE / dz if dz != 0 else 0)
    light, owed = _ONE, np.float32(0)
    red = green = blue = np.float32(0)
    hit = np.float32(np.inf)
    asked = False
    while k < last:
        s = (np.float32(k) + _HALF) * step
        u, v, w = ex + s * dx, ey + s * dy, ez + s * dz
        a = min(max(int(u * per_brick), 0), cell.shape[0] - 1)
        e = min(max(int(v * per_brick), 0), cell.shape[1] - 1)
        c = min(max(int(w * per_brick), 0), cell.shape[2] - 1)
        owner = cell[a, e, c]
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
        block, index = density[owner], voxel[owner]
        bx, by, bz = ex - np.float32(a) * width + _HALF, ey - np.float32(e) * width + _HALF, ez - np.float32(c) * width + _HALF
        while k < until:
            s = (np.float32(k) + _HALF) * step
            x, y, z = bx + s * dx, by + s * dy, bz + s * dz
            i, j, l = int(x), int(y), int(z)
            at = i * plane + j * side + l
            k += 1
            if np.float32(block[at]).view(np.int32) < 0:
                continue
            fx, fy, fz = x - np.float32(i), y - np.float32(j), z - np.float32(l)
            sigma = _trilinear(block, at, side, plane, fx, fy, fz)
            if sigma <= 0:
                continue
            left = light * _exp_minus(sigma * reach)
            owed += light - left
            if owed > np.float32(FAINT):
                if not asked:
                    _harmonics(looking[0], looking[1], looking[2], degree, basis)
                    asked = True
                r, g, b = _colour(index, at, side, plane, fx, fy, fz, sh, scale, basis)
                red += owed * r
                green += owed * g
                blue += owed * b
                owed = np.float32(0)
            if left <= _HALF and light > _HALF:
                hit = s - _HALF * step + np.log(2 * light) / (sigma * reach) * step
            light = left
            if light < np.float32(STOP):
                k = last
                break
    out[0], out[1], out[2], out[3], out[4] = red, green, blue, _ONE - light, hit
