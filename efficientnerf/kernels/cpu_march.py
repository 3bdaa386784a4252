"""Marching rays through a packed tree (numba), block by block: what a ray sees, and what a picture's pixels see.

numba's cache looks at the file of the kernel that is called, not at those of the functions written into it: whoever changes this file or those that it
imports deletes `__pycache__` beside it, or sees the old march.

Every ray samples at t = t_enter + (k + 1/2) * step, step = half a voxel, whatever it skips, so that skipping empty space changes no value.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from efficientnerf.kernels.cpu_blocks import COLOURS, EXACT, LOOSE, VOXELS, basis_into, colour, fill, sum_of_harmonics
from efficientnerf.kernels.lanes import EXP2, apart, four_at, logistic, plus_scaled, scaled, together

STEP = 0.5  # of a voxel
STOP = 1e-3  # transmittance at which a ray may end
SPENT = 5e-4  # transmittance at which one ends here: colours that are summed once for a voxel may need the rest of what renderings may differ by
FAINT = 1e-4  # weight under which a sample's colour is not looked up; the next one that is looked up stands for it
ROUNDING = 1e-3  # of a step: a skip that is computed in float32 ends so much early, for it must never end late

_HALF, _ONE = np.float32(0.5), np.float32(1)
LOG2E = math.log2(math.e)
_EXP2 = tuple(np.float32(c) for c in EXP2)


@numba.njit(cache=True, inline="always", error_model="numpy", fastmath=LOOSE)
def _exp2_minus(x):  # type: ignore[no-untyped-def]
    """2^-x for float32 x >= 0."""
    y = min(x, np.float32(126))
    whole = np.int32(y)
    f = y - np.float32(whole)
    p = _ONE + f * (_EXP2[0] + f * (_EXP2[1] + f * (_EXP2[2] + f * (_EXP2[3] + f * _EXP2[4]))))
    return p * np.int32((np.int32(127) - whole) << np.int32(23)).view(np.float32)


@numba.njit(cache=True, inline="always", error_model="numpy", fastmath=LOOSE)
def _trilinear(block, at, j, i, fx, fy, fz):  # type: ignore[no-untyped-def]
    """Interpolates the first of the four numbers of eight voxels from `at`; j and i are the strides of y and x."""
    k = 4
    a = block[at] + fz * (block[at + k] - block[at])
    b = block[at + j] + fz * (block[at + j + k] - block[at + j])
    c = block[at + i] + fz * (block[at + i + k] - block[at + i])
    d = block[at + i + j] + fz * (block[at + i + j + k] - block[at + i + j])
    e = a + fy * (b - a)
    return e + fx * (c + fy * (d - c) - e)


@numba.njit(cache=True, inline="always", error_model="numpy", fastmath=LOOSE)
def _weights(fx, fy, fz):  # type: ignore[no-untyped-def]
    """Of the eight voxels of an interpolation, z fastest."""
    gx, gy, gz = _ONE - fx, _ONE - fy, _ONE - fz
    a, b, c, d = gx * gy, gx * fy, fx * gy, fx * fy
    return a * gz, a * fz, b * gz, b * fz, c * gz, c * fz, d * gz, d * fz


@numba.njit(cache=True, inline="always", error_model="numpy", fastmath=LOOSE)
def _mixed(block, at, j, i, fx, fy, fz):  # type: ignore[no-untyped-def]
    """Interpolates the four numbers of eight voxels: density and colours before the sigmoid; these are no-numbers where a voxel is not stored."""
    w0, w1, w2, w3, w4, w5, w6, w7 = _weights(fx, fy, fz)
    one = plus_scaled(scaled(w0, four_at(block, at)), w1, four_at(block, at + 4))
    one = plus_scaled(plus_scaled(one, w2, four_at(block, at + j)), w3, four_at(block, at + j + 4))
    other = plus_scaled(scaled(w4, four_at(block, at + i)), w5, four_at(block, at + i + 4))
    other = plus_scaled(plus_scaled(other, w6, four_at(block, at + i + j)), w7, four_at(block, at + i + j + 4))
    return plus_scaled(one, _ONE, other)


@numba.njit(cache=True, error_model="numpy", fastmath=LOOSE)
def _partial(block, at, j, i, fx, fy, fz):  # type: ignore[no-untyped-def]
    """Zero, and colours before the sigmoid interpolated over those of the eight voxels that are stored."""
    w0, w1, w2, w3, w4, w5, w6, w7 = _weights(fx, fy, fz)
    weight = (w0, w1, w2, w3, w4, w5, w6, w7)
    total = r = g = b = np.float32(0)
    for n in range(8):
        one = at + (i if n & 4 else 0) + (j if n & 2 else 0) + (4 if n & 1 else 0)
        red = block[one + 1]
        if red == red:
            total += weight[n]
            r += weight[n] * red
            g += weight[n] * block[one + 2]
            b += weight[n] * block[one + 3]
    share = _ONE / total if total > 0 else np.float32(0)
    return together(np.float32(0), r * share, g * share, b * share)


@numba.njit(cache=True, error_model="numpy", fastmath=LOOSE)
def _exact(words, at, j, i, fx, fy, fz, grid, basis):  # type: ignore[no-untyped-def]
    """The same where a block says which voxels are stored: their harmonics along the direction that `basis` is of."""
    w0, w1, w2, w3, w4, w5, w6, w7 = _weights(fx, fy, fz)
    weight = w0, w1, w2, w3, w4, w5, w6, w7
    total = red = green = blue = np.float32(0)
    for n in range(8):
        voxel = words[at + (i if n & 4 else 0) + (j if n & 2 else 0) + (5 if n & 1 else 1)]
        if voxel >= 0:
            r, g, b = sum_of_harmonics(np.int64(voxel), grid, basis)
            total += weight[n]
            red += weight[n] * r
            green += weight[n] * g
            blue += weight[n] * b
    share = _ONE / total if total > 0 else np.float32(0)
    return together(np.float32(0), red * share, green * share, blue * share)


@numba.njit(cache=True, error_model="numpy")
def _density(u, v, w, grid, view, pool):  # type: ignore[no-untyped-def]
    """Density (times the view's scale) at a point in voxel coordinates, float32; 0 outside of the grid and in an empty cell."""
    brick = grid.brick
    if not (0 <= u < grid.nx * brick and 0 <= v < grid.ny * brick and 0 <= w < grid.nz * brick):
        return np.float32(0)
    part = np.float32(1 / brick)
    a, e, c = min(int(u * part), grid.nx - 1), min(int(v * part), grid.ny - 1), min(int(w * part), grid.nz - 1)
    there = (a * grid.ny + e) * grid.nz + c
    if grid.leap[there] > 0:
        return np.float32(0)
    owner = np.int64(grid.brick_index[there])
    slot = pool.slot[owner]
    if slot < 0:
        slot = fill(owner, grid, view.scale, pool)
    x, y, z = u - np.float32(a * brick) + _HALF, v - np.float32(e * brick) + _HALF, w - np.float32(c * brick) + _HALF
    i, j, k = int(x), int(y), int(z)
    side = brick + 2
    at = slot * pool.size + 4 * ((i * side + j) * side + k)
    return _trilinear(pool.values, at, 4 * side, 4 * side * side, x - np.float32(i), y - np.float32(j), z - np.float32(k))


@numba.njit(cache=True, error_model="numpy")
def normal_into(u, v, w, grid, view, pool, out):  # type: ignore[no-untyped-def]
    """Unit normal (down the gradient, central differences of one voxel) into `out`; zero where the density is flat."""
    gx = _density(u + _ONE, v, w, grid, view, pool) - _density(u - _ONE, v, w, grid, view, pool)
    gy = _density(u, v + _ONE, w, grid, view, pool) - _density(u, v - _ONE, w, grid, view, pool)
    gz = _density(u, v, w + _ONE, grid, view, pool) - _density(u, v, w - _ONE, grid, view, pool)
    length = np.sqrt(gx * gx + gy * gy + gz * gz)
    if length > 0:
        out[0], out[1], out[2] = -gx / length, -gy / length, -gz / length
    else:
        out[0] = out[1] = out[2] = np.float32(0)


@numba.njit(cache=True, error_model="numpy", fastmath=LOOSE)
def march(ex, ey, ez, dx, dy, dz, k, last, grid, view, look_x, look_y, look_z, basis, pool, out):  # type: ignore[no-untyped-def]
    """What lies on a ray from its k-th to its last-th sample.

    ex, ey, ez, dx, dy, dz  float32: where it enters the box, voxel coordinates, and its unit direction
    view, pool              see `cpu_blocks`; the view's scale is the length of a step, units of the frame, times log2(e)
    look_x, look_y, look_z  float32: the direction that the harmonics are asked for
    basis                   (K,) float32: room for its harmonics
    out                     (9,) float32: red, green, blue, opacity; where half of the light is gone, voxels from the entry, or infinity; and what it took:
                            cells looked at, samples tested, samples interpolated, colours looked up
    """
    values, words, brick = pool.values, pool.words, grid.brick
    side = brick + 2
    plane = side * side
    step, width, per_brick = np.float32(STEP), np.float32(brick), np.float32(1 / brick)
    big, none = np.float32(1e30), np.float32(0)
    row, layer = np.float32(side), np.float32(plane)
    # The parameter at which a face at x is crossed: x * slope + shift; never, along an axis that the ray does not move on.
    slope_x, slope_y, slope_z = (_ONE / dx if dx != 0 else none), (_ONE / dy if dy != 0 else none), (_ONE / dz if dz != 0 else none)
    light, owed = _ONE, np.float32(0)
    total = together(np.float32(0), np.float32(0), np.float32(0), np.float32(0))
    hit = np.float32(np.inf)
    looked = False
    cells = tested = mixed = colours = 0
    while k < last:
        s = (np.float32(k) + _HALF) * step
        u, v, w = ex + s * dx, ey + s * dy, ez + s * dz
        a = min(max(int(u * per_brick), 0), grid.nx - 1)
        e = min(max(int(v * per_brick), 0), grid.ny - 1)
        c = min(max(int(w * per_brick), 0), grid.nz - 1)
        there = (a * grid.ny + e) * grid.nz + c
        leap = np.int64(grid.leap[there])
        cells += 1
        far = max(leap, 1)
        # To the end of the cell, or of the empty cube round it: the nearest of its three far faces.
        x = np.float32(a + far if dx > 0 else a - far + 1) * width
        y = np.float32(e + far if dy > 0 else e - far + 1) * width
        z = np.float32(c + far if dz > 0 else c - far + 1) * width
        tx = (x - ex) * slope_x if dx != 0 else big
        ty = (y - ey) * slope_y if dy != 0 else big
        tz = (z - ez) * slope_z if dz != 0 else big
        end = min(min(tx, ty, tz) * np.float32(1 / STEP) - np.float32(0.5 + ROUNDING), np.float32(last))
        until = min(max(int(np.ceil(end)), k + 1), last)
        if leap > 0:
            k = until
            continue
        owner = np.int64(grid.brick_index[there])
        slot = pool.slot[owner]
        if slot < 0:
            slot = fill(owner, grid, view.scale, pool)
        kind, begin = pool.kind[slot], slot * pool.size
        tested -= k
        bx, by, bz = ex - np.float32(a) * width + _HALF, ey - np.float32(e) * width + _HALF, ez - np.float32(c) * width + _HALF
        while k < until:
            s = (np.float32(k) + _HALF) * step
            x, y, z = bx + s * dx, by + s * dy, bz + s * dz
            i, j, l = np.floor(x), np.floor(y), np.floor(z)
            at = begin + 4 * np.int64(np.int32(i * layer + j * row + l))
            k += 1
            if words[at] < 0:
                continue
            mixed += 1
            if kind == VOXELS:
                kind = colour(slot, grid, view, pool)
            fx, fy, fz = x - i, y - j, z - l
            mix, red = total, _ONE
            if kind == COLOURS:
                mix = _mixed(values, at, 4 * side, 4 * plane, fx, fy, fz)
                sigma, red, _, _ = apart(mix)
            else:
                sigma = _trilinear(values, at, 4 * side, 4 * plane, fx, fy, fz)
            if sigma <= 0:
                continue
            left = light * _exp2_minus(sigma)
            owed += light - left
            if owed > np.float32(FAINT):
                colours += 1
                if kind == EXACT:
                    if not looked:
                        basis_into(look_x, look_y, look_z, view.degree, basis)
                        looked = True
                    mix = _exact(words, at, 4 * side, 4 * plane, fx, fy, fz, grid, basis)
                elif red != red:
                    mix = _partial(values, at, 4 * side, 4 * plane, fx, fy, fz)
                total = plus_scaled(total, owed, logistic(mix))
                owed = np.float32(0)
            if left <= _HALF and light > _HALF:
                hit = s - _HALF * step + np.log2(2 * light) / sigma * step
            light = left
            if light < np.float32(SPENT):
                last = k
                break
        tested += k
    _, out[0], out[1], out[2] = apart(total)
    out[3], out[4] = _ONE - light, hit
    out[5], out[6], out[7], out[8] = cells, tested, mixed, colours
