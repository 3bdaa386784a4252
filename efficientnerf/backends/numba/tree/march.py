"""Marching rays through a packed tree (numba), block by block: what a ray sees, and what a picture's pixels see.

numba's cache looks at the file of the kernel that is called, not at those of the functions written into it: whoever changes this file or those that it
imports deletes `__pycache__` beside it, or sees the old march.

Samples whose eight voxels hold something are composited four at a time: that many fill the widest registers that processors have, and one branch
decides for all of them.

Every ray samples at t = t_enter + (k + 1/2) * step, step = half a voxel, whatever it skips, so that skipping empty space changes no value.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.simd import (
    EXP2_COEFFICIENTS,
    add_scaled4,
    exp2_neg4,
    load4,
    pack4,
    sigmoid,
    split16,
    store4,
    trilinear4,
    unpack4,
)  # fmt: skip
from efficientnerf.backends.numba.tree.blocks import COLOURS, EXACT, LOOSE, QUEUE, basis_into, fill, sum_of_harmonics

STEP = 0.5  # of a voxel
STOP = 1e-3  # transmittance at which a ray may end
SPENT = 5e-4  # transmittance at which one ends here: colours that are summed once for a voxel may need the rest of what renderings may differ by
FAINT = 1e-4  # weight under which a sample's colour is not looked up; the next one that is looked up stands for it
ROUNDING = 1e-3  # of a step: a skip that is computed in float32 ends so much early, for it must never end late

_HALF, _ONE = np.float32(0.5), np.float32(1)
LOG2E = math.log2(math.e)
_EXP2 = tuple(np.float32(c) for c in EXP2_COEFFICIENTS)


@numba.njit(cache=True, inline="always", error_model="numpy", fastmath=LOOSE)
def _exp2_neg(x):  # type: ignore[no-untyped-def]
    """2^-x for float32 x >= 0."""
    y = min(x, np.float32(126))
    whole = np.int32(y)
    f = y - np.float32(whole)
    p = _ONE + f * (_EXP2[0] + f * (_EXP2[1] + f * (_EXP2[2] + f * (_EXP2[3] + f * _EXP2[4]))))
    return p * np.int32((np.int32(127) - whole) << np.int32(23)).view(np.float32)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _lives(owner, voxel, grid):  # type: ignore[no-untyped-def]
    """Whether any of the eight voxels from one of a block on has density."""
    return (grid.live[owner * grid.words + (voxel >> 6)] >> (voxel & 63)) & 1 != 0


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


@numba.njit(cache=True, error_model="numpy", fastmath=LOOSE)
def _exact(words, at, j, i, fx, fy, fz, grid, basis):  # type: ignore[no-untyped-def]
    """Zero, and colours before the sigmoid where a block says which voxels are stored: their harmonics along the direction that `basis` is of."""
    w0, w1, w2, w3, w4, w5, w6, w7 = _weights(fx, fy, fz)
    weight = w0, w1, w2, w3, w4, w5, w6, w7
    total = red = green = blue = np.float32(0)
    for n in range(8):
        voxel = words[at + (i if n & 4 else 0) + (j if n & 2 else 0) + (5 if n & 1 else 1)]
        if voxel >= 0:
            r, g, b = sum_of_harmonics(np.int64(voxel), grid, basis, 0, 1)
            total += weight[n]
            red += weight[n] * r
            green += weight[n] * g
            blue += weight[n] * b
    share = _ONE / total if total > 0 else np.float32(0)
    return pack4(np.float32(0), red * share, green * share, blue * share)


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
    x, y, z = u - np.float32(a * brick) + _HALF, v - np.float32(e * brick) + _HALF, w - np.float32(c * brick) + _HALF
    i, j, k = int(x), int(y), int(z)
    side = brick + 2
    voxel = (i * side + j) * side + k
    if not _lives(owner, voxel, grid):
        return np.float32(0)
    slot = np.int64(pool.slot[owner])
    if slot < 0:
        slot = fill(owner, grid, view, pool)
    at = slot * pool.size + 4 * voxel
    return _trilinear(pool.values, at, 4 * side, 4 * side * side, x - np.float32(i), y - np.float32(j), z - np.float32(k))


@numba.njit(cache=True, inline="always", error_model="numpy")
def _difference(x, stride, at, row, layer, fx, fy, fz, brick, pool):  # type: ignore[no-untyped-def]
    """What the density changes by from a voxel before a point to a voxel after it, along the axis of that stride; no-number where one lies in another cell.

    x                 where the point lies in its block along that axis, voxels
    at, fx, fy, fz    where the first of its eight voxels lies, and where it lies itself between them
    """
    change = np.float32(np.nan)
    if _ONE + _HALF <= x < np.float32(brick) - _HALF:
        change = _trilinear(pool.values, at + stride, row, layer, fx, fy, fz) - _trilinear(pool.values, at - stride, row, layer, fx, fy, fz)
    return change


@numba.njit(cache=True, error_model="numpy")
def normal_into(u, v, w, grid, view, pool, out):  # type: ignore[no-untyped-def]
    """Unit normal (down the gradient, central differences of one voxel) into `out`; zero where the density is flat."""
    brick = grid.brick
    side, part = brick + 2, np.float32(1 / brick)
    gx = gy = gz = np.float32(np.nan)
    a, e, c = min(max(int(u * part), 0), grid.nx - 1), min(max(int(v * part), 0), grid.ny - 1), min(max(int(w * part), 0), grid.nz - 1)
    there = (a * grid.ny + e) * grid.nz + c
    if grid.leap[there] == 0:
        owner = np.int64(grid.brick_index[there])
        slot = np.int64(pool.slot[owner])
        if slot < 0:
            slot = fill(owner, grid, view, pool)
        x, y, z = u - np.float32(a * brick) + _HALF, v - np.float32(e * brick) + _HALF, w - np.float32(c * brick) + _HALF
        i, j, k = min(max(int(x), 0), brick), min(max(int(y), 0), brick), min(max(int(z), 0), brick)
        fx, fy, fz = x - np.float32(i), y - np.float32(j), z - np.float32(k)
        row, layer = 4 * side, 4 * side * side
        at = slot * pool.size + i * layer + j * row + 4 * k
        gx = _difference(x, layer, at, row, layer, fx, fy, fz, brick, pool)
        gy = _difference(y, row, at, row, layer, fx, fy, fz, brick, pool)
        gz = _difference(z, 4, at, row, layer, fx, fy, fz, brick, pool)
    # Beyond the cell's faces lies another block, or nothing whatever this one holds.
    if gx != gx:
        gx = _density(u + _ONE, v, w, grid, view, pool) - _density(u - _ONE, v, w, grid, view, pool)
    if gy != gy:
        gy = _density(u, v + _ONE, w, grid, view, pool) - _density(u, v - _ONE, w, grid, view, pool)
    if gz != gz:
        gz = _density(u, v, w + _ONE, grid, view, pool) - _density(u, v, w - _ONE, grid, view, pool)
    length = np.sqrt(gx * gx + gy * gy + gz * gz)
    if length > 0:
        out[0], out[1], out[2] = -gx / length, -gy / length, -gz / length
    else:
        out[0] = out[1] = out[2] = np.float32(0)


class Bench(NamedTuple):
    """Where a ray is worked on, arrays as pointers.

    x, y, z  (QUEUE,) float32: where the samples that wait lie between voxels, 0 to 1; their voxels are in `Pool.waiting`
    along    (QUEUE,) float32: how far along the ray, voxels
    state    (10,) float32: see below
    basis    (K,) float32: the ray's harmonics
    """

    x: Any
    y: Any
    z: Any
    along: Any
    state: Any
    basis: Any


# What is known of a ray: four numbers of which the last three are its colour; the light that is left; what samples absorbed that have no colour yet; where
# half of the light was gone; whether its harmonics are known; and how many samples were interpolated, and colours looked up.
TOTAL, LIGHT, OWED, HIT, LOOKED, MIXED, LOOKUPS = 0, 4, 5, 6, 7, 8, 9


@numba.njit(cache=True, inline="always", error_model="numpy", fastmath=LOOSE)
def _crossing(light, left, sigma, along):  # type: ignore[no-untyped-def]
    """Where half of the light is gone, if that is within a sample; else infinity."""
    if left <= _HALF and light > _HALF:
        return along - _HALF * np.float32(STEP) + np.log2(2 * light) / sigma * np.float32(STEP)
    return np.float32(np.inf)


@numba.njit(cache=True, error_model="numpy", fastmath=LOOSE)
def _composite(count, grid, pool, bench):  # type: ignore[no-untyped-def]
    """Adds the samples that wait, the first `count` of them, to what is known of a ray; the light that is left. Their blocks hold colours."""
    at, x, y, z, along, state = pool.waiting, bench.x, bench.y, bench.z, bench.along, bench.state
    side, spent = grid.brick + 2, np.float32(SPENT)
    for n in range(count, QUEUE):
        at[n] = pool.blocks * pool.size
    sigma, mix = trilinear4(
        pool.values, at[0], at[1], at[2], at[3], 4 * side, 4 * side * side, pack4(x[0], x[1], x[2], x[3]), pack4(y[0], y[1], y[2], y[3]),
        pack4(z[0], z[1], z[2], z[3]),
    )  # fmt: skip
    e0, e1, e2, e3 = unpack4(exp2_neg4(sigma))
    c0, c1, c2, c3 = split16(sigmoid(mix))
    # A ray that is spent ends at once, wherever its samples are cut into groups.
    l0 = state[LIGHT]
    l1 = l0 * e0
    l2 = l1 * e1 if l1 >= spent else l1
    l3 = l2 * e2 if l2 >= spent else l2
    l4 = l3 * e3 if l3 >= spent else l3
    total = add_scaled4(add_scaled4(load4(state, TOTAL), l0 - l1, c0), l1 - l2, c1)
    store4(state, TOTAL, add_scaled4(add_scaled4(total, l2 - l3, c2), l3 - l4, c3))
    if l4 <= _HALF and l0 > _HALF:
        s0, s1, s2, s3 = unpack4(sigma)
        first = min(_crossing(l0, l1, s0, along[0]), _crossing(l1, l2, s1, along[1]))
        state[HIT] = min(first, _crossing(l2, l3, s2, along[2]), _crossing(l3, l4, s3, along[3]))
    used = np.float32(min(count, 1 + (l1 >= spent) + (l2 >= spent) + (l3 >= spent)))
    state[LIGHT], state[MIXED], state[LOOKUPS] = l4, state[MIXED] + used, state[LOOKUPS] + used
    return l4


@numba.njit(cache=True, error_model="numpy", fastmath=LOOSE)
def _composite_exactly(count, grid, view, pool, bench, look_x, look_y, look_z):  # type: ignore[no-untyped-def]
    """The same where blocks hold voxels."""
    at, state, side, light = pool.waiting, bench.state, grid.brick + 2, bench.state[LIGHT]
    j, i = 4 * side, 4 * side * side
    for n in range(count):
        if light < np.float32(SPENT):
            break
        state[MIXED] += _ONE
        fx, fy, fz = bench.x[n], bench.y[n], bench.z[n]
        sigma = _trilinear(pool.values, at[n], j, i, fx, fy, fz)
        left = light * _exp2_neg(sigma)
        owed = state[OWED] + light - left
        if owed > np.float32(FAINT):
            if state[LOOKED] == 0:
                basis_into(look_x, look_y, look_z, view.degree, bench.basis)
                state[LOOKED] = _ONE
            state[LOOKUPS] += _ONE
            colour = sigmoid(_exact(pool.words, at[n], j, i, fx, fy, fz, grid, bench.basis))
            store4(state, TOTAL, add_scaled4(load4(state, TOTAL), owed, colour))
            owed = np.float32(0)
        state[OWED] = owed
        state[HIT] = min(state[HIT], _crossing(light, left, sigma, bench.along[n]))
        light = left
    state[LIGHT] = light
    return light


@numba.njit(cache=True, inline="always", error_model="numpy")
def _composited(kind, count, grid, view, pool, bench, look_x, look_y, look_z):  # type: ignore[no-untyped-def]
    """Adds the samples that wait to what is known of a ray; the light that is left."""
    if kind == EXACT:
        return _composite_exactly(count, grid, view, pool, bench, look_x, look_y, look_z)
    return _composite(count, grid, pool, bench)


@numba.njit(cache=True, error_model="numpy", fastmath=LOOSE)
def march(ex, ey, ez, dx, dy, dz, first, end, grid, view, look_x, look_y, look_z, pool, bench, out):  # type: ignore[no-untyped-def]
    """What lies on a ray from one of its samples to the one before another.

    first, end              these two, from 0 on; below 2^24
    ex, ey, ez, dx, dy, dz  float32: where it enters the box, voxel coordinates, and its unit direction
    view, pool              see `cpu_blocks`; the view's scale is the length of a step, units of the frame, times log2(e)
    look_x, look_y, look_z  float32: the direction that the harmonics are asked for
    out                     (9,) float32: red, green, blue, opacity; where half of the light is gone, voxels from the entry, or infinity; and what it took:
                            cells looked at, samples tested, samples interpolated, colours looked up
    """
    brick, state = grid.brick, bench.state
    side = brick + 2
    step, width, per_brick = np.float32(STEP), np.float32(brick), np.float32(1 / brick)
    big, none = np.float32(1e30), np.float32(0)
    row, layer = np.float32(side), np.float32(side * side)
    # A face at x is crossed at (x - ex) * slope + never, and lies beside cell a, `far` cells ahead, at (a + beside + far * ahead) * width.
    slope_x, slope_y, slope_z = (_ONE / dx if dx != 0 else none), (_ONE / dy if dy != 0 else none), (_ONE / dz if dz != 0 else none)
    never_x, never_y, never_z = (none if dx != 0 else big), (none if dy != 0 else big), (none if dz != 0 else big)
    ahead_x, ahead_y, ahead_z = (_ONE if dx > 0 else -_ONE), (_ONE if dy > 0 else -_ONE), (_ONE if dz > 0 else -_ONE)
    beside_x, beside_y, beside_z = (none if dx > 0 else _ONE), (none if dy > 0 else _ONE), (none if dz > 0 else _ONE)
    most_x, most_y, most_z = np.float32(grid.nx - 1), np.float32(grid.ny - 1), np.float32(grid.nz - 1)
    for n in range(10):
        state[n] = none
    state[LIGHT], state[HIT] = _ONE, np.float32(np.inf)
    waiting, kind = 0, np.int64(COLOURS)
    cells, tested = 0, none
    # Whole numbers are kept as float32: each step waits for the one before, and conversions would take a good part of that time.
    k, last = np.float32(first), np.float32(end)
    while k < last:
        s = (k + _HALF) * step
        a = min(max(np.floor((ex + s * dx) * per_brick), none), most_x)
        e = min(max(np.floor((ey + s * dy) * per_brick), none), most_y)
        c = min(max(np.floor((ez + s * dz) * per_brick), none), most_z)
        there = (np.int64(a) * grid.ny + np.int64(e)) * grid.nz + np.int64(c)
        leap = grid.leap[there]
        cells += 1
        # To the end of the cell, or of the empty cube round it: the nearest of its three far faces.
        far = np.float32(max(leap, np.uint8(1)))
        tx = ((a + beside_x + far * ahead_x) * width - ex) * slope_x + never_x
        ty = ((e + beside_y + far * ahead_y) * width - ey) * slope_y + never_y
        tz = ((c + beside_z + far * ahead_z) * width - ez) * slope_z + never_z
        until = min(max(np.ceil(min(tx, ty, tz) * np.float32(1 / STEP) - np.float32(0.5 + ROUNDING)), k + _ONE), last)
        if leap > 0:
            k = until
            continue
        owner, begin = np.int64(grid.brick_index[there]), np.int64(-1)
        tested -= k
        bx, by, bz = ex - a * width + _HALF, ey - e * width + _HALF, ez - c * width + _HALF
        while k < until:
            s = (k + _HALF) * step
            x, y, z = bx + s * dx, by + s * dy, bz + s * dz
            i, j, l = np.floor(x), np.floor(y), np.floor(z)
            voxel = np.int64(np.int32(i * layer + j * row + l))
            k += _ONE
            if not _lives(owner, voxel, grid):
                continue
            if begin < 0:
                slot = np.int64(pool.slot[owner])
                if slot < 0:
                    slot = fill(owner, grid, view, pool)
                begin = slot * pool.size
                if pool.kind[slot] != kind:
                    if waiting > 0 and _composited(kind, waiting, grid, view, pool, bench, look_x, look_y, look_z) < np.float32(SPENT):
                        last, waiting = k, 0
                        break
                    waiting, kind = 0, np.int64(pool.kind[slot])
            pool.waiting[waiting] = begin + 4 * voxel
            bench.x[waiting], bench.y[waiting], bench.z[waiting], bench.along[waiting] = x - i, y - j, z - l, s
            waiting += 1
            if waiting == QUEUE:
                waiting = 0
                if _composited(kind, QUEUE, grid, view, pool, bench, look_x, look_y, look_z) < np.float32(SPENT):
                    last = k
                    break
        tested += k
    if waiting > 0:
        _composited(kind, waiting, grid, view, pool, bench, look_x, look_y, look_z)
    out[0], out[1], out[2] = state[TOTAL + 1], state[TOTAL + 2], state[TOTAL + 3]
    out[3], out[4] = _ONE - state[LIGHT], state[HIT]
    out[5], out[6], out[7], out[8] = cells, tested, state[MIXED], state[LOOKUPS]
