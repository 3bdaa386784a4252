"""Compositing of one sample of each of sixteen rays (numba).

The eight voxels around a sample are read two by two, see `rows`; weights, transmittances and colours are computed for all rays at once. Where the camera is far
away, voxels have the colours of the view; near it their harmonics are summed along each ray.
"""

from __future__ import annotations

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.simd import add_scaled4, advanced, load4, pack4, sigmoid, store4
from efficientnerf.backends.numba.tree.march import MIN_COLOUR_WEIGHT, PACKED_EARLY_STOP, STEP, exp2_neg
from efficientnerf.backends.numba.tree.packets.lanes import (
    bits_of,
    broadcast16,
    channels16,
    exp2_neg16,
    floor16,
    load16,
    lowest_bit,
    mask_of,
    select16,
    store16,
    store_channels16,
    to_int16,
)
from efficientnerf.backends.numba.tree.packets.layout import (
    BASIS,
    BLUE,
    CACHE,
    CACHED_BITS,
    COLOURS,
    DISTANCE,
    GAIN,
    GREEN,
    HALF_DISTANCE,
    HAS_BASIS,
    INTERPOLATED,
    LOOKUPS,
    OWNER,
    PAIR,
    PENDING_WEIGHT,
    PLACE,
    RED,
    ROW,
    SAMPLE,
    SH_X,
    SH_Y,
    SH_Z,
    TRANSMITTANCE,
    VOXEL,
    WEIGHT,
    X,
    Y,
    Z,
)
from efficientnerf.backends.numba.tree.packets.rows import pair_of
from efficientnerf.backends.numba.tree.view_colours import sh_basis, sh_colour

_HALF, _ONE, _NONE = np.float32(0.5), np.float32(1), np.float32(0)
_LEAST = np.float32(1e-30)  # weight of stored voxels below which a sample has no colour


@numba.njit(cache=True, inline="always", error_model="numpy")
def _find_voxels(lane, grid, ints):  # type: ignore[no-untyped-def]
    """The eight voxels of a ray's sample; N in place of those of a row that stores neither."""
    side = grid.brick + 2
    first, k = np.int64(ints[OWNER + lane]) * side * side + np.int64(ints[ROW + lane]), np.int64(ints[PLACE + lane])
    for n in range(4):
        voxel, pair = pair_of(first + (side if n & 2 else 0) + (n & 1), k, grid.rows)
        voxel = voxel if pair != 0 else grid.voxels
        ints[VOXEL + 32 * n + lane] = voxel
        ints[VOXEL + 32 * n + 16 + lane] = voxel + (pair == 3)
        ints[PAIR + 16 * n + lane] = pair


@numba.njit(cache=True, inline="always", error_model="numpy")
def _weigh(n, edge, fz, gz, floats, ints):  # type: ignore[no-untyped-def]
    """Weights of the voxels of row n, into `floats`; returns their sum."""
    pair = load16(ints, PAIR + 16 * n)
    first, second = edge * select16(pair == 2, fz, select16(pair == 0, _NONE, gz)), edge * select16(pair == 3, fz, _NONE)
    store16(floats, WEIGHT + 32 * n, first)
    store16(floats, WEIGHT + 32 * n + 16, second)
    return first + second


@numba.njit(cache=True, inline="always", error_model="numpy")
def _add_voxel(total, n, lane, colours, floats, ints):  # type: ignore[no-untyped-def]
    return add_scaled4(total, floats[WEIGHT + 16 * n + lane], load4(colours, 4 * np.int64(ints[VOXEL + 16 * n + lane])))


@numba.njit(cache=True, inline="always", error_model="numpy")
def _mix_view_colours(lane, colours, floats, ints):  # type: ignore[no-untyped-def]
    """Weighted density, red, green and blue of a ray's sample."""
    even = _add_voxel(_add_voxel(pack4(_NONE, _NONE, _NONE, _NONE), 0, lane, colours, floats, ints), 2, lane, colours, floats, ints)
    odd = _add_voxel(_add_voxel(pack4(_NONE, _NONE, _NONE, _NONE), 1, lane, colours, floats, ints), 3, lane, colours, floats, ints)
    even = _add_voxel(_add_voxel(even, 4, lane, colours, floats, ints), 6, lane, colours, floats, ints)
    odd = _add_voxel(_add_voxel(odd, 5, lane, colours, floats, ints), 7, lane, colours, floats, ints)
    store4(floats, SAMPLE + 4 * lane, even + odd)


@numba.njit(cache=True, error_model="numpy")
def _evaluate_basis(view, floats, ints):  # type: ignore[no-untyped-def]
    """Harmonics of the rays' directions, once."""
    if ints[HAS_BASIS] == 0:
        sh_basis(load16(floats, SH_X), load16(floats, SH_Y), load16(floats, SH_Z), view.degree, advanced(floats, BASIS))
        ints[HAS_BASIS] = 1


@numba.njit(cache=True, error_model="numpy")
def _colours_along(voxel, entry, grid, view, floats):  # type: ignore[no-untyped-def]
    """Density, red, green and blue of a voxel along each of the rays, into an entry of the cache."""
    n, y = np.int64(grid.voxel_of[voxel]), load16(floats, BASIS)
    if grid.coded:
        table, base, code = grid.base_table, 3 * n, n * grid.groups
        red, green = y * table[3 * np.int64(grid.base[base])], y * table[3 * np.int64(grid.base[base + 1]) + 1]
        blue = y * table[3 * np.int64(grid.base[base + 2]) + 2]
        for k in range(grid.terms - 1):
            e, y = 4 * (k * grid.entries + np.int64(grid.codes[code + grid.code_columns[k]])), load16(floats, BASIS + 16 * k + 16)
            red, green, blue = red + y * grid.palette[e + 1], green + y * grid.palette[e + 2], blue + y * grid.palette[e + 3]
    else:
        e = 3 * grid.terms * n
        red, green, blue = y * grid.sh[e], y * grid.sh[e + 1], y * grid.sh[e + 2]
        for k in range(1, grid.terms):
            y = load16(floats, BASIS + 16 * k)
            red, green, blue = red + y * grid.sh[e + 3 * k], green + y * grid.sh[e + 3 * k + 1], blue + y * grid.sh[e + 3 * k + 2]
    density = broadcast16(grid.density[voxel] * view.density_scale)
    store_channels16(floats, COLOURS + 64 * entry, density, red, green, blue)


@numba.njit(cache=True, error_model="numpy")
def _mix_cached(lane, grid, view, floats, ints):  # type: ignore[no-untyped-def]
    """`_mix_view_colours` by the harmonics of voxels along the rays: those that rays which are neighbours share are summed once for all of them."""
    total = pack4(_NONE, _NONE, _NONE, _NONE)
    for n in range(8):
        weight, voxel = floats[WEIGHT + 16 * n + lane], np.int64(ints[VOXEL + 16 * n + lane])
        if weight != 0:
            entry = (voxel * 0x9E3779B1 & 0xFFFFFFFF) >> 32 - CACHED_BITS
            if ints[CACHE + entry] != voxel:
                _colours_along(voxel, entry, grid, view, floats)
                ints[CACHE + entry] = voxel
            total = add_scaled4(total, weight, load4(floats, COLOURS + 64 * entry + 4 * lane))
    store4(floats, SAMPLE + 4 * lane, total)


@numba.njit(cache=True, error_model="numpy")
def _mix_harmonics(lane, grid, view, floats, ints):  # type: ignore[no-untyped-def]
    """The same for rays that share nothing, and the weight of the colour; none is looked up until that is MIN_COLOUR_WEIGHT."""
    sigma = red = green = blue = _NONE
    for n in range(8):
        sigma += floats[WEIGHT + 16 * n + lane] * grid.density[ints[VOXEL + 16 * n + lane]]
    sigma *= view.density_scale
    before = floats[TRANSMITTANCE + lane]
    gain = floats[PENDING_WEIGHT + lane] + before - before * exp2_neg(sigma)
    floats[PENDING_WEIGHT + lane], floats[GAIN + lane] = gain, _NONE
    if gain > np.float32(MIN_COLOUR_WEIGHT):
        floats[PENDING_WEIGHT + lane], floats[GAIN + lane] = _NONE, gain
        floats[LOOKUPS + lane] += _ONE
        for n in range(8):
            weight = floats[WEIGHT + 16 * n + lane]
            if weight != 0:
                r, g, b = sh_colour(np.int64(grid.voxel_of[ints[VOXEL + 16 * n + lane]]), grid, advanced(floats, BASIS), lane, 16)
                red, green, blue = red + weight * r, green + weight * g, blue + weight * b
    store4(floats, SAMPLE + 4 * lane, pack4(sigma, red, green, blue))


@numba.njit(cache=True, error_model="numpy")
def _half_distance(lane, floats):  # type: ignore[no-untyped-def]
    """Distance at which the transmittance falls to one half, within a ray's sample."""
    within = np.log2(2 * floats[TRANSMITTANCE + lane]) / floats[SAMPLE + 4 * lane] - _HALF
    floats[HALF_DISTANCE + lane] = floats[DISTANCE + lane] + within * np.float32(STEP)


@numba.njit(cache=True, error_model="numpy")
def composite(ready, near, shared, grid, view, colours, floats, ints):  # type: ignore[no-untyped-def]
    """Composites the samples of some rays, given as bits, those of `near` by harmonics; returns which rays end, their transmittance being spent.

    shared  whether rays beside each other are neighbours, which share voxels
    """
    x, y, z = load16(floats, X), load16(floats, Y), load16(floats, Z)
    i, j, k = floor16(x), floor16(y), floor16(z)
    store16(ints, ROW, to_int16(i * np.float32(grid.brick + 2) + j))
    store16(ints, PLACE, to_int16(k))
    left = ready
    while left != 0:
        _find_voxels(lowest_bit(left), grid, ints)
        left &= left - 1
    fx, fy, fz = x - i, y - j, z - k
    gx, gy, gz = _ONE - fx, _ONE - fy, _ONE - fz
    weight = _weigh(0, gx * gy, fz, gz, floats, ints) + _weigh(1, gx * fy, fz, gz, floats, ints)
    weight = weight + (_weigh(2, fx * gy, fz, gz, floats, ints) + _weigh(3, fx * fy, fz, gz, floats, ints))
    left = ready & ~near
    while left != 0:
        _mix_view_colours(lowest_bit(left), colours, floats, ints)
        left &= left - 1
    if near != 0:
        _evaluate_basis(view, floats, ints)
    left, alone = near, near
    while left != 0:
        if shared:
            _mix_cached(lowest_bit(left), grid, view, floats, ints)
        else:
            _mix_harmonics(lowest_bit(left), grid, view, floats, ints)
        left &= left - 1
    if shared:
        alone = np.int64(0)
    sigma, red, green, blue = channels16(floats, SAMPLE)
    some, before = mask_of(ready), load16(floats, TRANSMITTANCE)
    after = before * exp2_neg16(select16(some, sigma, _NONE))
    gain = select16(mask_of(alone), load16(floats, GAIN), before - after)
    # A lane without a sample gains nothing, whatever an earlier one left in it.
    share = _ONE / select16(weight > _LEAST, weight, broadcast16(_ONE))
    store16(floats, RED, load16(floats, RED) + gain * sigmoid(red * share))
    store16(floats, GREEN, load16(floats, GREEN) + gain * sigmoid(green * share))
    store16(floats, BLUE, load16(floats, BLUE) + gain * sigmoid(blue * share))
    used = select16(some, broadcast16(_ONE), _NONE)
    store16(floats, INTERPOLATED, load16(floats, INTERPOLATED) + used)
    store16(floats, LOOKUPS, load16(floats, LOOKUPS) + select16(mask_of(alone), _NONE, used))
    left = bits_of((after <= _HALF) & (before > _HALF))
    while left != 0:
        _half_distance(lowest_bit(left), floats)
        left &= left - 1
    store16(floats, TRANSMITTANCE, after)
    return bits_of(after < np.float32(PACKED_EARLY_STOP))
