"""Compositing of one sample of each ray of a packet (numba), in two steps: `locate` and `blend`.

The eight voxels around a sample are read two by two, see `rows`; weights, transmittances and colours are computed for all rays at once. Where the camera is far
away, voxels have the colours of the view; near it their harmonics are summed along each ray.
"""

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.tree.march import MIN_COLOUR_WEIGHT, PACKED_EARLY_STOP
from efficientnerf.backends.numba.tree.packets import layout
from efficientnerf.backends.numba.tree.packets.layout import BATCH_VOXELS, LANES
from efficientnerf.backends.numba.tree.view_colours import sh_basis, sh_colour
from efficientnerf.backends.numba.vector.halves import mix_pairs
from efficientnerf.backends.numba.vector.maths import bits_of, broadcast, exp2_neg, floor, fma, lowest_bit, mask_of, pack, popcount, select, sigmoid, to_int32
from efficientnerf.backends.numba.vector.memory import (
    advanced,
    gather_groups,
    load,
    load_groups,
    load_three,
    prefetch_groups,
    store,
    store_groups,
    store_three,
)

_HALF, _ONE, _NONE = np.float32(0.5), np.float32(1), np.float32(0)
_LEAST = np.float32(1e-30)  # weight of stored voxels below which a sample has no colour


@numba.njit(cache=True, inline="always", error_model="numpy")
def _weigh(n, first, mask, edge, bit, fz, gz, floats, ints):
    """The first voxel of row n, and weights of it and of the next; returns their sum.

    bit  of the first voxel in the mask; voxels that are not stored have no weight, and what lies in their place is any voxel beside them
    """
    store(ints, LANES * n, first + popcount(mask & ((bit << 1) - 1)) - 1)
    here, next_ = select((mask & bit) != 0, edge * gz, _NONE), select((mask & (bit << 1)) != 0, edge * fz, _NONE)
    store_groups(floats, layout.WEIGHT + 2 * LANES * n, (here, next_))
    return here + next_


@numba.njit(cache=True, error_model="numpy")
def locate(x, y, z, distance, owner, grid, colours, ints, batch, voxels):
    """Which voxels are around a sample of each ray of a packet, and their weights, into a batch; asks for their colours, which `blend` needs later.

    x, y, z  in the block of the brick `owner`
    batch    float32, see `layout`, and voxels int32
    """
    i, j, k = floor(x), floor(y), floor(z)
    side = grid.brick + 2
    row = owner * (side * side) + to_int32(i * np.float32(side) + j)
    if grid.narrow:
        store(ints, layout.ROW, row)
        mask, next_mask = gather_groups(grid.rows, ints, layout.ROW, 2, LANES)
        far_mask, last_mask = gather_groups(advanced(grid.rows, side), ints, layout.ROW, 2, LANES)
        first, next_first, far_first, last_first = mask >> side, next_mask >> side, far_mask >> side, last_mask >> side
    else:
        store(ints, layout.ROW, row * 2)
        first, mask, next_first, next_mask = gather_groups(grid.rows, ints, layout.ROW, 4, LANES)
        far_first, far_mask, last_first, last_mask = gather_groups(advanced(grid.rows, 2 * side), ints, layout.ROW, 4, LANES)
    fx, fy, fz = x - i, y - j, z - k
    gx, gy, gz = _ONE - fx, _ONE - fy, _ONE - fz
    bit = broadcast(np.int32(1), LANES) << to_int32(k)
    weight = _weigh(0, first, mask, gx * gy, bit, fz, gz, batch, voxels) + _weigh(1, next_first, next_mask, gx * fy, bit, fz, gz, batch, voxels)
    far = _weigh(2, far_first, far_mask, fx * gy, bit, fz, gz, batch, voxels) + _weigh(3, last_first, last_mask, fx * fy, bit, fz, gz, batch, voxels)
    store(batch, layout.TOTAL, weight + far)
    store(batch, layout.DISTANCE, distance)
    prefetch_groups(colours, voxels, BATCH_VOXELS)


@numba.njit(cache=True, error_model="numpy")
def _evaluate_basis(view, floats, ints):
    """Harmonics of the rays' directions, once."""
    if ints[layout.HAS_BASIS] == 0:
        sh_basis(*load_three(floats, layout.SH_ALONG, LANES), view.degree, advanced(floats, layout.BASIS))
        ints[layout.HAS_BASIS] = 1


@numba.njit(cache=True, error_model="numpy")
def _colours_along(voxel, entry, grid, view, floats):
    """Density, red, green and blue of a voxel along each of the rays, into an entry of the cache."""
    y = load(floats, layout.BASIS, LANES)
    if grid.coded:
        table, base, code = grid.base_table, 3 * voxel, voxel * grid.groups
        red, green = y * table[3 * np.int64(grid.base[base])], y * table[3 * np.int64(grid.base[base + 1]) + 1]
        blue = y * table[3 * np.int64(grid.base[base + 2]) + 2]
        for k in range(grid.terms - 1):
            e, y = 4 * (k * grid.entries + np.int64(grid.codes[code + grid.code_columns[k]])), load(floats, layout.BASIS + LANES * k + LANES, LANES)
            red, green, blue = red + y * grid.palette[e + 1], green + y * grid.palette[e + 2], blue + y * grid.palette[e + 3]
    else:
        e = 3 * grid.terms * np.int64(grid.voxel_of[voxel])
        red, green, blue = y * grid.sh[e], y * grid.sh[e + 1], y * grid.sh[e + 2]
        for k in range(1, grid.terms):
            y = load(floats, layout.BASIS + LANES * k, LANES)
            red, green, blue = red + y * grid.sh[e + 3 * k], green + y * grid.sh[e + 3 * k + 1], blue + y * grid.sh[e + 3 * k + 2]
    density = broadcast(grid.density[voxel] * view.density_scale, LANES)
    store_groups(floats, layout.COLOURS + 4 * LANES * entry, (density, red, green, blue))


@numba.njit(cache=True, error_model="numpy")
def _mix_cached(lane, grid, view, floats, ints, batch, voxels):
    """`_mix_view_colours` by the harmonics of voxels along the rays: those that rays which are neighbours share are summed once for all of them."""
    total = pack((_NONE, _NONE, _NONE, _NONE))
    for n in range(8):
        weight, voxel = batch[layout.WEIGHT + 2 * LANES * (n >> 1) + 2 * lane + (n & 1)], np.int64(voxels[LANES * (n >> 1) + lane]) + (n & 1)
        if weight != 0:
            entry = (voxel * 0x9E3779B1 & 0xFFFFFFFF) >> 32 - layout.CACHED_BITS
            if ints[layout.CACHE + entry] != voxel:
                _colours_along(voxel, entry, grid, view, floats)
                ints[layout.CACHE + entry] = voxel
            total = fma(weight, load(floats, layout.COLOURS + 4 * LANES * entry + 4 * lane, 4), total)
    store(floats, layout.SAMPLE + 4 * lane, total)


@numba.njit(cache=True, error_model="numpy")
def _mix_harmonics(lane, grid, view, floats, batch, voxels):
    """The same for rays that share nothing, and the weight of the colour; none is looked up until that is MIN_COLOUR_WEIGHT."""
    sigma = red = green = blue = _NONE
    for n in range(8):
        weight = batch[layout.WEIGHT + 2 * LANES * (n >> 1) + 2 * lane + (n & 1)]
        if weight != 0:
            sigma += weight * grid.density[np.int64(voxels[LANES * (n >> 1) + lane]) + (n & 1)]
    sigma *= view.density_scale
    before = floats[layout.TRANSMITTANCE + lane]
    gain = floats[layout.PENDING_WEIGHT + lane] + before - before * exp2_neg(sigma)
    floats[layout.PENDING_WEIGHT + lane], floats[layout.GAIN + lane] = gain, _NONE
    if gain > np.float32(MIN_COLOUR_WEIGHT):
        floats[layout.PENDING_WEIGHT + lane], floats[layout.GAIN + lane] = _NONE, gain
        floats[layout.LOOKUPS + lane] += _ONE
        for n in range(8):
            weight = batch[layout.WEIGHT + 2 * LANES * (n >> 1) + 2 * lane + (n & 1)]
            if weight != 0:
                r, g, b = sh_colour(np.int64(voxels[LANES * (n >> 1) + lane]) + (n & 1), grid, advanced(floats, layout.BASIS), lane, LANES)
                red, green, blue = red + weight * r, green + weight * g, blue + weight * b
    store(floats, layout.SAMPLE + 4 * lane, pack((sigma, red, green, blue)))


@numba.njit(cache=True, error_model="numpy")
def _half_distances(lanes, sigma, view, floats, batch):
    """Distances at which the transmittance of some rays, given as bits, falls to one half, within their samples."""
    store(floats, layout.SAMPLE, sigma)
    while lanes != 0:
        lane = lowest_bit(lanes)
        within = np.log2(2 * floats[layout.TRANSMITTANCE + lane]) / floats[layout.SAMPLE + lane] - _HALF
        floats[layout.HALF_DISTANCE + lane] = batch[layout.DISTANCE + lane] + within * np.float32(view.step)
        lanes &= lanes - 1


@numba.njit(cache=True, error_model="numpy")
def _mix_near(near, shared, grid, view, floats, ints, batch, voxels):
    """Weighted densities and colours of some rays' samples, given as bits, by harmonics, into SAMPLE."""
    _evaluate_basis(view, floats, ints)
    while near != 0:
        if shared:
            _mix_cached(lowest_bit(near), grid, view, floats, ints, batch, voxels)
        else:
            _mix_harmonics(lowest_bit(near), grid, view, floats, batch, voxels)
        near &= near - 1


@numba.njit(cache=True, error_model="numpy")
def blend(ready, near, shared, grid, view, colours, floats, ints, batch, voxels):
    """Composites the samples of some rays, given as bits, those of `near` by harmonics; returns which rays end, their transmittance being spent.

    shared         whether rays beside each other are neighbours, which share voxels
    batch, voxels  what `locate` left
    """
    sigma = red = green = blue = broadcast(_NONE, LANES)
    if ready & ~near != 0:
        sigma, red, green, blue = mix_pairs(advanced(batch, layout.WEIGHT), voxels, colours, LANES)
    alone = broadcast(_NONE, LANES) > _NONE
    if near != 0:
        _mix_near(near, shared, grid, view, floats, ints, batch, voxels)
        some, sums = mask_of(near, LANES), load_groups(floats, layout.SAMPLE, 4, LANES)
        sigma, red = select(some, sums[0], sigma), select(some, sums[1], red)
        green, blue = select(some, sums[2], green), select(some, sums[3], blue)
        if not shared:
            alone = some
    some, before, weight = mask_of(ready, LANES), load(floats, layout.TRANSMITTANCE, LANES), load(batch, layout.TOTAL, LANES)
    after = before * exp2_neg(select(some, sigma, _NONE))
    gain = select(alone, load(floats, layout.GAIN, LANES), before - after)
    # A lane without a sample gains nothing, whatever an earlier one left in it.
    share = _ONE / select(weight > _LEAST, weight, _ONE)
    r, g, b = load_three(floats, layout.COLOUR, LANES)
    store_three(floats, layout.COLOUR, LANES, r + gain * sigmoid(red * share), g + gain * sigmoid(green * share), b + gain * sigmoid(blue * share))
    used = select(some, _ONE, _NONE)
    store(floats, layout.INTERPOLATED, load(floats, layout.INTERPOLATED, LANES) + used)
    store(floats, layout.LOOKUPS, load(floats, layout.LOOKUPS, LANES) + select(alone, _NONE, used))
    halved = bits_of((after <= _HALF) & (before > _HALF))
    if halved != 0:
        _half_distances(halved, sigma, view, floats, batch)
    store(floats, layout.TRANSMITTANCE, after)
    return bits_of(after < np.float32(PACKED_EARLY_STOP))
