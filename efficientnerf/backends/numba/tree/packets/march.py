"""Marching of a packet of rays, one a lane, through a cascade of a packed, interpolated tree (numba).

Each ray goes on to its next sample of which one of the eight voxels has density; when half of them are at one, or have none left, the voxels around these are
looked up together. Were all waited for, the gaps between surfaces that rays cross would be crossed one after the other. They are composited when the next are
looked up, for their colours take so long to come from memory; so rays go one sample beyond their end. docs/experiments/renderer.md

All rays sample at t = t_enter + (k + 1/2) step, whatever is skipped and whatever the other lanes do: neither changes any value.
"""

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.tree.march import PARALLEL, SKIP_MARGIN
from efficientnerf.backends.numba.tree.packets import layout
from efficientnerf.backends.numba.tree.packets.composite import blend, locate
from efficientnerf.backends.numba.tree.packets.layout import LANES
from efficientnerf.backends.numba.vector.maths import (
    absolute,
    bits_of,
    broadcast,
    ceil,
    floor,
    lowest_bit,
    mask_of,
    maximum,
    minimum,
    popcount,
    select,
    to_float32,
    to_int32,
)
from efficientnerf.backends.numba.vector.memory import advanced, gather, load, load_three, prefetch, store

_HALF, _ONE, _NONE, _FAR = np.float32(0.5), np.float32(1), np.float32(0), np.float32(1e30)
_SKIP = np.float32(0.5 + SKIP_MARGIN)
_LINE = 16  # int32 of a cache line


@numba.njit(cache=True, inline="always", error_model="numpy")
def _axis(d):
    """How rays cross the faces across an axis: slope, never, ahead and beside. A ray crosses the plane at x at (x - ex) * slope + never, and the face of cell
    a, `far` cells ahead, is at (a + beside + far * ahead) * width.

    Along an axis that a ray hardly moves on it never does; 1 / dx would be infinite, zero times that no number, and the ray would stay where it is.
    """
    moves, ahead = absolute(d) >= PARALLEL, d > _NONE
    return (
        select(moves, _ONE / d, _NONE), select(moves, _NONE, _FAR), select(ahead, _ONE, -_ONE),
        select(ahead, _NONE, _ONE),
    )  # fmt: skip


@numba.njit(cache=True, inline="always", error_model="numpy")
def _near(a, e, c, grid, view):
    """Which cells are too near for colours of the view, see `View`."""
    d, brick = view.direction, np.float32(grid.brick)
    x, y, z = a * brick + _HALF * brick, e * brick + _HALF * brick, c * brick + _HALF * brick
    u = x * np.float32(d[0]) + y * np.float32(d[1]) + z * np.float32(d[2]) + np.float32(d[3])
    v = x * np.float32(d[4]) + y * np.float32(d[5]) + z * np.float32(d[6]) + np.float32(d[7])
    w = x * np.float32(d[8]) + y * np.float32(d[9]) + z * np.float32(d[10]) + np.float32(d[11])
    least = np.float32(view.direction_rate * (view.min_distance + 2 * grid.brick + 4))
    return u * u + v * v + w * w < least * least


@numba.njit(cache=True, inline="always", error_model="numpy")
def _prefetch_rows(lanes, grid, ints):
    """Asks for the tables of rows of the bricks in OWNER, before the first sample there needs them: docs/experiments/renderer.md"""
    size, before = (grid.brick + 2) * (grid.brick + 2) * (1 if grid.narrow else 2), np.int64(-1)
    while lanes != 0:
        owner = np.int64(ints[layout.OWNER + lowest_bit(lanes)])
        if owner != before:
            prefetch(grid.rows, owner * size)
            prefetch(grid.rows, owner * size + _LINE)
            prefetch(grid.rows, owner * size + 2 * _LINE)
            for n in range(3 * _LINE, size, _LINE):
                prefetch(grid.rows, owner * size + n)
        lanes, before = lanes & (lanes - 1), owner


@numba.njit(cache=True, error_model="numpy")
def march(shared, grid, view, colours, floats, ints):
    """Adds the samples FIRST <= k < LAST of a packet's parts in a cascade to their states, see `layout`; both below 2^24. The half distance is one from the
    entry, voxels.

    shared  whether rays beside each other are neighbours
    view    see `View`; its density scale is the step, in units of the frame, times log2(e)
    """
    ex, ey, ez = load_three(floats, layout.ENTRY, LANES)
    dx, dy, dz = load_three(floats, layout.ALONG, LANES)
    side, words = grid.brick + 2, 2 * grid.mask_words
    width, per_brick = np.float32(grid.brick), np.float32(1 / grid.brick)
    row, layer = np.float32(side), np.float32(side * side)
    slope_x, never_x, ahead_x, beside_x = _axis(dx)
    slope_y, never_y, ahead_y, beside_y = _axis(dy)
    slope_z, never_z, ahead_z, beside_z = _axis(dz)
    step, per_step = np.float32(view.step), np.float32(1 / view.step)
    most_x, most_y, most_z = np.float32(grid.nx - 1), np.float32(grid.ny - 1), np.float32(grid.nz - 1)
    some_near = view.min_distance > -np.inf
    cells = np.int32(grid.nx * grid.ny * grid.nz if grid.directed else 0)
    octant = select(dx > _NONE, cells, 0) + select(dy > _NONE, 2 * cells, 0)
    octant = octant + select(dz > _NONE, 4 * cells, 0)
    # Integers are kept as float32: conversions would lengthen the dependency chain from step to step.
    k, last = load(floats, layout.FIRST, LANES), load(floats, layout.LAST, LANES)
    until, owner, visited, tested = k, broadcast(np.int32(0), LANES), broadcast(_NONE, LANES), broadcast(_NONE, LANES)
    bx = by = bz = px = py = pz = distance = broadcast(_NONE, LANES)
    going, ready, close = bits_of(k < last), np.int64(0), np.int64(0)
    pending, near, at = np.int64(0), np.int64(0), 0  # the batch before, whose colours have been asked for; which of them are near the camera
    batches, voxels = advanced(floats, layout.BATCHES), advanced(ints, layout.BATCHES_OF_VOXELS)
    while going != 0:
        lanes = mask_of(going, LANES)
        enters = lanes & (k >= until)
        entering = bits_of(enters)
        if entering != 0:
            s = (k + _HALF) * step
            a = minimum(maximum(floor((ex + s * dx) * per_brick), _NONE), most_x)
            e = minimum(maximum(floor((ey + s * dy) * per_brick), _NONE), most_y)
            c = minimum(maximum(floor((ez + s * dz) * per_brick), _NONE), most_z)
            cell = select(enters, (to_int32(a) * grid.ny + to_int32(e)) * grid.nz + to_int32(c), 0)
            leap = gather(grid.octants, cell + octant)
            visited = visited + select(enters, _ONE, _NONE)
            # A ray leaves the cell, or the empty cube of cells around it, at the nearest of three faces.
            far = maximum(to_float32(leap), _ONE)
            tx = ((a + beside_x + far * ahead_x) * width - ex) * slope_x + never_x
            ty = ((e + beside_y + far * ahead_y) * width - ey) * slope_y + never_y
            tz = ((c + beside_z + far * ahead_z) * width - ez) * slope_z + never_z
            then = minimum(maximum(ceil(minimum(tx, minimum(ty, tz)) * per_step - _SKIP), k + _ONE), last)
            full = enters & (leap == 0)
            until = select(enters, then, until)
            k = select(enters & (leap > 0), then, k)
            filled = bits_of(full)
            if filled != 0:
                owner = select(full, gather(grid.brick_index, select(full, cell, 0)), owner)
                store(ints, layout.OWNER, owner)
                _prefetch_rows(filled, grid, ints)
                bx = select(full, ex - a * width + _HALF, bx)
                by = select(full, ey - e * width + _HALF, by)
                bz = select(full, ez - c * width + _HALF, bz)
                if some_near:
                    close = (close & ~filled) | (filled & bits_of(_near(a, e, c, grid, view)))
        inside = lanes & (k < until)
        if bits_of(inside) != 0:
            s = (k + _HALF) * step
            x, y, z = bx + s * dx, by + s * dy, bz + s * dz
            voxel = to_int32(floor(x) * layer + floor(y) * row + floor(z))
            word = gather(grid.has_density, select(inside, owner * words + (voxel >> 5), 0))
            found = inside & ((word >> (voxel & 31)) & 1 != 0)
            tested = tested + select(inside, _ONE, _NONE)
            k = select(inside, k + _ONE, k)
            px, py, pz, distance = select(found, x, px), select(found, y, py), select(found, z, pz), select(found, s, distance)
            ready |= bits_of(found)
        going = bits_of(k < last) & ~ready & going
        if ready != 0 and popcount(ready) >= popcount(going):
            ended = np.int64(0)
            locate(px, py, pz, distance, owner, grid, colours, ints, advanced(batches, layout.BATCH_FLOATS * at), advanced(voxels, layout.BATCH_VOXELS * at))
            at = 1 - at
            if pending != 0:
                batch, of_batch = advanced(batches, layout.BATCH_FLOATS * at), advanced(voxels, layout.BATCH_VOXELS * at)
                ended = blend(pending, pending & near, shared, grid, view, colours, floats, ints, batch, of_batch)
            pending, near = ready & ~ended, close
            going, ready = (going | (ready & bits_of(k < last))) & ~ended, np.int64(0)
    if pending != 0:
        at = 1 - at
        batch, of_batch = advanced(batches, layout.BATCH_FLOATS * at), advanced(voxels, layout.BATCH_VOXELS * at)
        blend(pending, pending & near, shared, grid, view, colours, floats, ints, batch, of_batch)
    store(floats, layout.VISITED, load(floats, layout.VISITED, LANES) + visited)
    store(floats, layout.TESTED, load(floats, layout.TESTED, LANES) + tested)
