"""Marching of rays through a packed, interpolated tree (numba), block by block.

Samples of which one of the eight voxels has density are composited QUEUE at a time, which fills the widest SIMD registers and amortises branches.

All rays sample at t = t_enter + (k + 1/2) STEP, whatever is skipped: skipping empty space changes no value.
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
from efficientnerf.backends.numba.tree.blocks import QUEUE, VIEW_COLOURS, VOXEL_INDICES, fill_block
from efficientnerf.backends.numba.tree.view_colours import FASTMATH, sh_basis, sh_colour

STEP = 0.5  # voxels
EARLY_STOP = 1e-3  # transmittance at which a ray may end
PACKED_EARLY_STOP = 5e-4  # transmittance at which a ray ends here; the rest of the tolerance is left to view colours
MIN_COLOUR_WEIGHT = 1e-4  # weight below which no colour is looked up; it is added to that of the next sample that has one
SKIP_MARGIN = 1e-3  # steps by which a skip ends early, so that float32 rounding never makes it end late

_HALF, _ONE = np.float32(0.5), np.float32(1)
LOG2E = math.log2(math.e)
PARALLEL = np.float32(1e-30)  # component of a unit direction below which a ray is parallel to a face
_EXP2 = tuple(np.float32(c) for c in EXP2_COEFFICIENTS)


@numba.njit(cache=True, inline="always", error_model="numpy", fastmath=FASTMATH)
def _exp2_neg(x):  # type: ignore[no-untyped-def]
    """2^-x of a float32 x >= 0."""
    y = min(x, np.float32(126))
    whole = np.int32(y)
    f = y - np.float32(whole)
    p = _ONE + f * (_EXP2[0] + f * (_EXP2[1] + f * (_EXP2[2] + f * (_EXP2[3] + f * _EXP2[4]))))
    return p * np.int32((np.int32(127) - whole) << np.int32(23)).view(np.float32)


@numba.njit(cache=True, inline="always", error_model="numpy")
def has_density(owner, voxel, grid):  # type: ignore[no-untyped-def]
    """Whether any of the eight voxels of a block that begin at `voxel` has density."""
    return (grid.has_density[owner * grid.mask_words + (voxel >> 6)] >> (voxel & 63)) & 1 != 0


@numba.njit(cache=True, inline="always", error_model="numpy", fastmath=FASTMATH)
def trilinear_density(block, at, j, i, fx, fy, fz):  # type: ignore[no-untyped-def]
    """Interpolates the density of the eight voxels from `at` on; j and i are the strides of y and x."""
    k = 4
    a = block[at] + fz * (block[at + k] - block[at])
    b = block[at + j] + fz * (block[at + j + k] - block[at + j])
    c = block[at + i] + fz * (block[at + i + k] - block[at + i])
    d = block[at + i + j] + fz * (block[at + i + j + k] - block[at + i + j])
    e = a + fy * (b - a)
    return e + fx * (c + fy * (d - c) - e)


@numba.njit(cache=True, inline="always", error_model="numpy", fastmath=FASTMATH)
def _weights(fx, fy, fz):  # type: ignore[no-untyped-def]
    """Trilinear weights of the eight voxels, z fastest."""
    gx, gy, gz = _ONE - fx, _ONE - fy, _ONE - fz
    a, b, c, d = gx * gy, gx * fy, fx * gy, fx * fy
    return a * gz, a * fz, b * gz, b * fz, c * gz, c * fz, d * gz, d * fz


@numba.njit(cache=True, error_model="numpy", fastmath=FASTMATH)
def _voxel_colours(ints, at, j, i, fx, fy, fz, grid, basis):  # type: ignore[no-untyped-def]
    """(0, red, green, blue) before the sigmoid from a block of voxel indices, by the harmonics `basis` of the ray; weights of stored voxels are normalised."""
    w0, w1, w2, w3, w4, w5, w6, w7 = _weights(fx, fy, fz)
    weight = w0, w1, w2, w3, w4, w5, w6, w7
    total = red = green = blue = np.float32(0)
    for n in range(8):
        voxel = ints[at + (i if n & 4 else 0) + (j if n & 2 else 0) + (5 if n & 1 else 1)]
        if voxel >= 0:
            r, g, b = sh_colour(np.int64(voxel), grid, basis, 0, 1)
            total += weight[n]
            red += weight[n] * r
            green += weight[n] * g
            blue += weight[n] * b
    scale = _ONE / total if total > 0 else np.float32(0)
    return pack4(np.float32(0), red * scale, green * scale, blue * scale)


class Ray(NamedTuple):
    """float32: entry point into the grid and unit direction, voxel coordinates, and the direction that harmonics are evaluated along."""

    ex: Any
    ey: Any
    ez: Any
    dx: Any
    dy: Any
    dz: Any
    sh_x: Any
    sh_y: Any
    sh_z: Any


class RayScratch(NamedTuple):
    """Working memory for one ray, arrays as pointers. The blocks of pending samples are in `Pool.pending`.

    x, y, z   (QUEUE,) float32: fractions of pending samples between voxels
    distance  (QUEUE,) float32: their distance along the ray, voxels
    state     (12,) float32: see below
    basis     (K,) float32: harmonics of the ray's direction
    """

    x: Any
    y: Any
    z: Any
    distance: Any
    state: Any
    basis: Any


# State of a ray: four numbers of which the last three are its colour; transmittance; weight of samples without a colour yet; distance at which the
# transmittance fell to one half; whether the harmonics are evaluated; and counts of interpolated samples, of colours looked up, of coarse cells visited and of
# samples tested.
COLOUR, TRANSMITTANCE, PENDING_WEIGHT, HALF_DISTANCE, HAS_BASIS, INTERPOLATED, LOOKUPS, VISITED, TESTED = 0, 4, 5, 6, 7, 8, 9, 10, 11
STATE = 12


@numba.njit(cache=True, inline="always", error_model="numpy", fastmath=FASTMATH)
def _half_distance(before, after, sigma, distance):  # type: ignore[no-untyped-def]
    """Distance at which the transmittance falls to one half, if that is within a sample, from `before` to `after`; else infinity."""
    if after <= _HALF and before > _HALF:
        return distance - _HALF * np.float32(STEP) + np.log2(2 * before) / sigma * np.float32(STEP)
    return np.float32(np.inf)


@numba.njit(cache=True, error_model="numpy", fastmath=FASTMATH)
def _composite_view_colours(count, grid, pool, scratch):  # type: ignore[no-untyped-def]
    """Composites the first `count` pending samples, whose blocks hold view colours; returns the transmittance."""
    at, x, y, z, distance, state = pool.pending, scratch.x, scratch.y, scratch.z, scratch.distance, scratch.state
    side, stop = grid.brick + 2, np.float32(PACKED_EARLY_STOP)
    for n in range(count, QUEUE):
        at[n] = pool.capacity * pool.block_size
    sigma, colour = trilinear4(
        pool.values, at[0], at[1], at[2], at[3], 4 * side, 4 * side * side, pack4(x[0], x[1], x[2], x[3]), pack4(y[0], y[1], y[2], y[3]),
        pack4(z[0], z[1], z[2], z[3]),
    )  # fmt: skip
    e0, e1, e2, e3 = unpack4(exp2_neg4(sigma))
    c0, c1, c2, c3 = split16(sigmoid(colour))
    # The ray stops at the first sample below `stop`, however samples fall into groups.
    t0 = state[TRANSMITTANCE]
    t1 = t0 * e0
    t2 = t1 * e1 if t1 >= stop else t1
    t3 = t2 * e2 if t2 >= stop else t2
    t4 = t3 * e3 if t3 >= stop else t3
    total = add_scaled4(add_scaled4(load4(state, COLOUR), t0 - t1, c0), t1 - t2, c1)
    store4(state, COLOUR, add_scaled4(add_scaled4(total, t2 - t3, c2), t3 - t4, c3))
    if t4 <= _HALF and t0 > _HALF:
        s0, s1, s2, s3 = unpack4(sigma)
        first = min(_half_distance(t0, t1, s0, distance[0]), _half_distance(t1, t2, s1, distance[1]))
        state[HALF_DISTANCE] = min(first, _half_distance(t2, t3, s2, distance[2]), _half_distance(t3, t4, s3, distance[3]))
    used = np.float32(min(count, 1 + (t1 >= stop) + (t2 >= stop) + (t3 >= stop)))
    state[TRANSMITTANCE], state[INTERPOLATED], state[LOOKUPS] = t4, state[INTERPOLATED] + used, state[LOOKUPS] + used
    return t4


@numba.njit(cache=True, error_model="numpy", fastmath=FASTMATH)
def _composite_voxels(count, ray, grid, view, pool, scratch):  # type: ignore[no-untyped-def]
    """The same for blocks of voxel indices."""
    at, state, side, transmittance = pool.pending, scratch.state, grid.brick + 2, scratch.state[TRANSMITTANCE]
    j, i = 4 * side, 4 * side * side
    for n in range(count):
        if transmittance < np.float32(PACKED_EARLY_STOP):
            break
        state[INTERPOLATED] += _ONE
        fx, fy, fz = scratch.x[n], scratch.y[n], scratch.z[n]
        sigma = trilinear_density(pool.values, at[n], j, i, fx, fy, fz)
        after = transmittance * _exp2_neg(sigma)
        weight = state[PENDING_WEIGHT] + transmittance - after
        if weight > np.float32(MIN_COLOUR_WEIGHT):
            if state[HAS_BASIS] == 0:
                sh_basis(ray.sh_x, ray.sh_y, ray.sh_z, view.degree, scratch.basis)
                state[HAS_BASIS] = _ONE
            state[LOOKUPS] += _ONE
            colour = sigmoid(_voxel_colours(pool.ints, at[n], j, i, fx, fy, fz, grid, scratch.basis))
            store4(state, COLOUR, add_scaled4(load4(state, COLOUR), weight, colour))
            weight = np.float32(0)
        state[PENDING_WEIGHT] = weight
        state[HALF_DISTANCE] = min(state[HALF_DISTANCE], _half_distance(transmittance, after, sigma, scratch.distance[n]))
        transmittance = after
    state[TRANSMITTANCE] = transmittance
    return transmittance


@numba.njit(cache=True, inline="always", error_model="numpy")
def _composite(kind, count, ray, grid, view, pool, scratch):  # type: ignore[no-untyped-def]
    """Composites pending samples in blocks of one kind; returns the transmittance."""
    if kind == VOXEL_INDICES:
        return _composite_voxels(count, ray, grid, view, pool, scratch)
    return _composite_view_colours(count, grid, pool, scratch)


@numba.njit(cache=True, error_model="numpy", fastmath=FASTMATH)
def begin_ray(scratch):  # type: ignore[no-untyped-def]
    """A ray that has met nothing."""
    for n in range(STATE):
        scratch.state[n] = np.float32(0)
    scratch.state[TRANSMITTANCE], scratch.state[HALF_DISTANCE] = _ONE, np.float32(np.inf)


@numba.njit(cache=True, error_model="numpy", fastmath=FASTMATH)
def march(ray, first, end, grid, view, pool, scratch):  # type: ignore[no-untyped-def]
    """Adds the samples first <= k < end of a ray's part in a cascade to its state; both below 2^24. The half distance is one from the entry, voxels.

    view  see `View`; its density scale is STEP, in units of the frame, times log2(e)
    """
    ex, ey, ez, dx, dy, dz = ray.ex, ray.ey, ray.ez, ray.dx, ray.dy, ray.dz
    brick, state = grid.brick, scratch.state
    side = brick + 2
    step, width, per_brick = np.float32(STEP), np.float32(brick), np.float32(1 / brick)
    big, none = np.float32(1e30), np.float32(0)
    row, layer = np.float32(side), np.float32(side * side)
    # A ray crosses the plane at x at (x - ex) * slope + never. The face of cell a, `far` cells ahead, is at (a + beside + far * ahead) * width.
    # Along an axis that it hardly moves on it never does; 1 / dx would be infinite, zero times that no number, and the ray would stay where it is.
    moves_x, moves_y, moves_z = abs(dx) >= PARALLEL, abs(dy) >= PARALLEL, abs(dz) >= PARALLEL
    slope_x, slope_y, slope_z = (_ONE / dx if moves_x else none), (_ONE / dy if moves_y else none), (_ONE / dz if moves_z else none)
    never_x, never_y, never_z = (none if moves_x else big), (none if moves_y else big), (none if moves_z else big)
    ahead_x, ahead_y, ahead_z = (_ONE if dx > 0 else -_ONE), (_ONE if dy > 0 else -_ONE), (_ONE if dz > 0 else -_ONE)
    beside_x, beside_y, beside_z = (none if dx > 0 else _ONE), (none if dy > 0 else _ONE), (none if dz > 0 else _ONE)
    most_x, most_y, most_z = np.float32(grid.nx - 1), np.float32(grid.ny - 1), np.float32(grid.nz - 1)
    pending, kind = 0, np.int64(VIEW_COLOURS)
    visited, tested = 0, none
    # Integers are kept as float32: conversions would lengthen the dependency chain from step to step.
    k, last = np.float32(first), np.float32(end)
    while k < last:
        s = (k + _HALF) * step
        a = min(max(np.floor((ex + s * dx) * per_brick), none), most_x)
        e = min(max(np.floor((ey + s * dy) * per_brick), none), most_y)
        c = min(max(np.floor((ez + s * dz) * per_brick), none), most_z)
        cell = (np.int64(a) * grid.ny + np.int64(e)) * grid.nz + np.int64(c)
        leap = grid.leap[cell]
        visited += 1
        # The ray leaves the cell, or the empty cube of cells around it, at the nearest of three faces.
        far = np.float32(max(leap, np.uint8(1)))
        tx = ((a + beside_x + far * ahead_x) * width - ex) * slope_x + never_x
        ty = ((e + beside_y + far * ahead_y) * width - ey) * slope_y + never_y
        tz = ((c + beside_z + far * ahead_z) * width - ez) * slope_z + never_z
        until = min(max(np.ceil(min(tx, ty, tz) * np.float32(1 / STEP) - np.float32(0.5 + SKIP_MARGIN)), k + _ONE), last)
        if leap > 0:
            k = until
            continue
        owner, begin = np.int64(grid.brick_index[cell]), np.int64(-1)
        tested -= k
        bx, by, bz = ex - a * width + _HALF, ey - e * width + _HALF, ez - c * width + _HALF
        while k < until:
            s = (k + _HALF) * step
            x, y, z = bx + s * dx, by + s * dy, bz + s * dz
            i, j, l = np.floor(x), np.floor(y), np.floor(z)
            voxel = np.int64(np.int32(i * layer + j * row + l))
            k += _ONE
            if not has_density(owner, voxel, grid):
                continue
            if begin < 0:
                slot = np.int64(pool.slot_of[owner])
                if slot < 0:
                    slot = fill_block(owner, grid, view, pool)
                begin = slot * pool.block_size
                if pool.kind[slot] != kind:
                    if pending > 0 and _composite(kind, pending, ray, grid, view, pool, scratch) < np.float32(PACKED_EARLY_STOP):
                        last, pending = k, 0
                        break
                    pending, kind = 0, np.int64(pool.kind[slot])
            pool.pending[pending] = begin + 4 * voxel
            scratch.x[pending], scratch.y[pending], scratch.z[pending], scratch.distance[pending] = x - i, y - j, z - l, s
            pending += 1
            if pending == QUEUE:
                pending = 0
                if _composite(kind, QUEUE, ray, grid, view, pool, scratch) < np.float32(PACKED_EARLY_STOP):
                    last = k
                    break
        tested += k
    if pending > 0:
        _composite(kind, pending, ray, grid, view, pool, scratch)
    state[VISITED], state[TESTED] = state[VISITED] + np.float32(visited), state[TESTED] + tested
