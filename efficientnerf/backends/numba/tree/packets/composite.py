"""Compositing of one sample of each ray of a packet (numba), in two steps: `locate` and `blend`.

The eight voxels around a sample are read two by two, see `rows`; weights, transmittances and colours are computed for all rays at once. Where the camera is far
away, voxels have the colours of the view; near it their harmonics are summed along each ray.
"""

from __future__ import annotations

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.simd import add_scaled4, advanced, load4, pack4, sigmoid, store4
from efficientnerf.backends.numba.tree.march import MIN_COLOUR_WEIGHT, PACKED_EARLY_STOP, exp2_neg
from efficientnerf.backends.numba.tree.packets.groups import channels, gather_fours, gather_pairs, prefetch_groups, store_channels, store_pairs
from efficientnerf.backends.numba.tree.packets.halves import mix_pairs
from efficientnerf.backends.numba.tree.packets.lanes import (
    bits_of,
    broadcast32,
    exp2_neg_lanes,
    floor_lanes,
    load32,
    lowest_bit,
    mask32,
    popcount_lanes,
    select_lanes,
    store_lanes,
    to_ints,
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
    LANES,
    LOOKUPS,
    PENDING_WEIGHT,
    RED,
    ROW,
    SAMPLE,
    SH_X,
    SH_Y,
    SH_Z,
    TOTAL,
    TRANSMITTANCE,
    WEIGHT,
)
from efficientnerf.backends.numba.tree.view_colours import sh_basis, sh_colour

_HALF, _ONE, _NONE = np.float32(0.5), np.float32(1), np.float32(0)
_LEAST = np.float32(1e-30)  # weight of stored voxels below which a sample has no colour


@numba.njit(cache=True, inline="always", error_model="numpy")
def _weigh(n, first, mask, edge, bit, fz, gz, floats, ints):  # type: ignore[no-untyped-def]
    """The first voxel of row n, and weights of it and of the next; returns their sum.

    bit  of the first voxel in the mask; voxels that are not stored have no weight, and what lies in their place is any voxel beside them
    """
    store_lanes(ints, LANES * n, first + popcount_lanes(mask & ((bit << 1) - 1)) - 1)
    here, next_ = select_lanes((mask & bit) != 0, edge * gz, _NONE), select_lanes((mask & (bit << 1)) != 0, edge * fz, _NONE)
    store_pairs(floats, WEIGHT + 2 * LANES * n, here, next_)
    return here + next_


@numba.njit(cache=True, error_model="numpy")
def locate(x, y, z, distance, owner, grid, colours, ints, batch, voxels):  # type: ignore[no-untyped-def]
    """Which voxels are around a sample of each ray of a packet, and their weights, into a batch; asks for their colours, which `blend` needs later.

    x, y, z  in the block of the brick `owner`
    batch    float32, see `layout`, and voxels int32
    """
    i, j, k = floor_lanes(x), floor_lanes(y), floor_lanes(z)
    side = grid.brick + 2
    row = owner * (side * side) + to_ints(i * np.float32(side) + j)
    if grid.narrow:
        store_lanes(ints, ROW, row)
        mask, next_mask = gather_pairs(grid.rows, ints, ROW)
        far_mask, last_mask = gather_pairs(advanced(grid.rows, side), ints, ROW)
        first, next_first, far_first, last_first = mask >> side, next_mask >> side, far_mask >> side, last_mask >> side
    else:
        store_lanes(ints, ROW, row * 2)
        first, mask, next_first, next_mask = gather_fours(grid.rows, ints, ROW)
        far_first, far_mask, last_first, last_mask = gather_fours(advanced(grid.rows, 2 * side), ints, ROW)
    fx, fy, fz = x - i, y - j, z - k
    gx, gy, gz = _ONE - fx, _ONE - fy, _ONE - fz
    bit = broadcast32(np.int32(1)) << to_ints(k)
    weight = _weigh(0, first, mask, gx * gy, bit, fz, gz, batch, voxels) + _weigh(1, next_first, next_mask, gx * fy, bit, fz, gz, batch, voxels)
    far = _weigh(2, far_first, far_mask, fx * gy, bit, fz, gz, batch, voxels) + _weigh(3, last_first, last_mask, fx * fy, bit, fz, gz, batch, voxels)
    store_lanes(batch, TOTAL, weight + far)
    store_lanes(batch, DISTANCE, distance)
    prefetch_groups(colours, voxels)


@numba.njit(cache=True, error_model="numpy")
def _evaluate_basis(view, floats, ints):  # type: ignore[no-untyped-def]
    """Harmonics of the rays' directions, once."""
    if ints[HAS_BASIS] == 0:
        sh_basis(load32(floats, SH_X), load32(floats, SH_Y), load32(floats, SH_Z), view.degree, advanced(floats, BASIS))
        ints[HAS_BASIS] = 1


@numba.njit(cache=True, error_model="numpy")
def _colours_along(voxel, entry, grid, view, floats):  # type: ignore[no-untyped-def]
    """Density, red, green and blue of a voxel along each of the rays, into an entry of the cache."""
    y = load32(floats, BASIS)
    if grid.coded:
        table, base, code = grid.base_table, 3 * voxel, voxel * grid.groups
        red, green = y * table[3 * np.int64(grid.base[base])], y * table[3 * np.int64(grid.base[base + 1]) + 1]
        blue = y * table[3 * np.int64(grid.base[base + 2]) + 2]
        for k in range(grid.terms - 1):
            e, y = 4 * (k * grid.entries + np.int64(grid.codes[code + grid.code_columns[k]])), load32(floats, BASIS + LANES * k + LANES)
            red, green, blue = red + y * grid.palette[e + 1], green + y * grid.palette[e + 2], blue + y * grid.palette[e + 3]
    else:
        e = 3 * grid.terms * np.int64(grid.voxel_of[voxel])
        red, green, blue = y * grid.sh[e], y * grid.sh[e + 1], y * grid.sh[e + 2]
        for k in range(1, grid.terms):
            y = load32(floats, BASIS + LANES * k)
            red, green, blue = red + y * grid.sh[e + 3 * k], green + y * grid.sh[e + 3 * k + 1], blue + y * grid.sh[e + 3 * k + 2]
    density = broadcast32(grid.density[voxel] * view.density_scale)
    store_channels(floats, COLOURS + 4 * LANES * entry, density, red, green, blue)


@numba.njit(cache=True, error_model="numpy")
def _mix_cached(lane, grid, view, floats, ints, batch, voxels):  # type: ignore[no-untyped-def]
    """`_mix_view_colours` by the harmonics of voxels along the rays: those that rays which are neighbours share are summed once for all of them."""
    total = pack4(_NONE, _NONE, _NONE, _NONE)
    for n in range(8):
        weight, voxel = batch[WEIGHT + 2 * LANES * (n >> 1) + 2 * lane + (n & 1)], np.int64(voxels[LANES * (n >> 1) + lane]) + (n & 1)
        if weight != 0:
            entry = (voxel * 0x9E3779B1 & 0xFFFFFFFF) >> 32 - CACHED_BITS
            if ints[CACHE + entry] != voxel:
                _colours_along(voxel, entry, grid, view, floats)
                ints[CACHE + entry] = voxel
            total = add_scaled4(total, weight, load4(floats, COLOURS + 4 * LANES * entry + 4 * lane))
    store4(floats, SAMPLE + 4 * lane, total)


@numba.njit(cache=True, error_model="numpy")
def _mix_harmonics(lane, grid, view, floats, batch, voxels):  # type: ignore[no-untyped-def]
    """The same for rays that share nothing, and the weight of the colour; none is looked up until that is MIN_COLOUR_WEIGHT."""
    sigma = red = green = blue = _NONE
    for n in range(8):
        weight = batch[WEIGHT + 2 * LANES * (n >> 1) + 2 * lane + (n & 1)]
        if weight != 0:
            sigma += weight * grid.density[np.int64(voxels[LANES * (n >> 1) + lane]) + (n & 1)]
    sigma *= view.density_scale
    before = floats[TRANSMITTANCE + lane]
    gain = floats[PENDING_WEIGHT + lane] + before - before * exp2_neg(sigma)
    floats[PENDING_WEIGHT + lane], floats[GAIN + lane] = gain, _NONE
    if gain > np.float32(MIN_COLOUR_WEIGHT):
        floats[PENDING_WEIGHT + lane], floats[GAIN + lane] = _NONE, gain
        floats[LOOKUPS + lane] += _ONE
        for n in range(8):
            weight = batch[WEIGHT + 2 * LANES * (n >> 1) + 2 * lane + (n & 1)]
            if weight != 0:
                r, g, b = sh_colour(np.int64(voxels[LANES * (n >> 1) + lane]) + (n & 1), grid, advanced(floats, BASIS), lane, LANES)
                red, green, blue = red + weight * r, green + weight * g, blue + weight * b
    store4(floats, SAMPLE + 4 * lane, pack4(sigma, red, green, blue))


@numba.njit(cache=True, error_model="numpy")
def _half_distances(lanes, sigma, view, floats, batch):  # type: ignore[no-untyped-def]
    """Distances at which the transmittance of some rays, given as bits, falls to one half, within their samples."""
    store_lanes(floats, SAMPLE, sigma)
    while lanes != 0:
        lane = lowest_bit(lanes)
        within = np.log2(2 * floats[TRANSMITTANCE + lane]) / floats[SAMPLE + lane] - _HALF
        floats[HALF_DISTANCE + lane] = batch[DISTANCE + lane] + within * np.float32(view.step)
        lanes &= lanes - 1


@numba.njit(cache=True, error_model="numpy")
def _mix_near(near, shared, grid, view, floats, ints, batch, voxels):  # type: ignore[no-untyped-def]
    """Weighted densities and colours of some rays' samples, given as bits, by harmonics, into SAMPLE."""
    _evaluate_basis(view, floats, ints)
    while near != 0:
        if shared:
            _mix_cached(lowest_bit(near), grid, view, floats, ints, batch, voxels)
        else:
            _mix_harmonics(lowest_bit(near), grid, view, floats, batch, voxels)
        near &= near - 1


@numba.njit(cache=True, error_model="numpy")
def blend(ready, near, shared, grid, view, colours, floats, ints, batch, voxels):  # type: ignore[no-untyped-def]
    """Composites the samples of some rays, given as bits, those of `near` by harmonics; returns which rays end, their transmittance being spent.

    shared         whether rays beside each other are neighbours, which share voxels
    batch, voxels  what `locate` left
    """
    sigma = red = green = blue = broadcast32(_NONE)
    if ready & ~near != 0:
        sigma, red, green, blue = mix_pairs(advanced(batch, WEIGHT), voxels, colours)
    alone = broadcast32(_NONE) > _NONE
    if near != 0:
        _mix_near(near, shared, grid, view, floats, ints, batch, voxels)
        some, sums = mask32(near), channels(floats, SAMPLE)
        sigma, red = select_lanes(some, sums[0], sigma), select_lanes(some, sums[1], red)
        green, blue = select_lanes(some, sums[2], green), select_lanes(some, sums[3], blue)
        if not shared:
            alone = some
    some, before, weight = mask32(ready), load32(floats, TRANSMITTANCE), load32(batch, TOTAL)
    after = before * exp2_neg_lanes(select_lanes(some, sigma, _NONE))
    gain = select_lanes(alone, load32(floats, GAIN), before - after)
    # A lane without a sample gains nothing, whatever an earlier one left in it.
    share = _ONE / select_lanes(weight > _LEAST, weight, broadcast32(_ONE))
    store_lanes(floats, RED, load32(floats, RED) + gain * sigmoid(red * share))
    store_lanes(floats, GREEN, load32(floats, GREEN) + gain * sigmoid(green * share))
    store_lanes(floats, BLUE, load32(floats, BLUE) + gain * sigmoid(blue * share))
    used = select_lanes(some, broadcast32(_ONE), _NONE)
    store_lanes(floats, INTERPOLATED, load32(floats, INTERPOLATED) + used)
    store_lanes(floats, LOOKUPS, load32(floats, LOOKUPS) + select_lanes(alone, _NONE, used))
    halved = bits_of((after <= _HALF) & (before > _HALF))
    if halved != 0:
        _half_distances(halved, sigma, view, floats, batch)
    store_lanes(floats, TRANSMITTANCE, after)
    return bits_of(after < np.float32(PACKED_EARLY_STOP))
