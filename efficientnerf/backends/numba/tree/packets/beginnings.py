"""Where the rays of a packet begin and end (numba): their origins and directions, and their parts in each cascade.

All rays of a packet are laid out at once, in lanes of float64.
"""

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.tree.march import PACKED_EARLY_STOP, most_samples
from efficientnerf.backends.numba.tree.packets.layout import (
    ALONG_X,
    ALONG_Y,
    ALONG_Z,
    BASIS,
    BEGIN,
    CACHE,
    CACHED,
    COSINE,
    DEPTH,
    DIRECTION,
    ENDS,
    ENTRY_X,
    ENTRY_Y,
    ENTRY_Z,
    FIRST,
    HALF_DISTANCE,
    HAS_BASIS,
    LANES,
    LAST,
    ORIGIN,
    SH_X,
    SH_Y,
    SH_Z,
    TRANSMITTANCE,
)
from efficientnerf.backends.numba.tree.ray_batch import PINHOLE, pinhole_direction, ray_at
from efficientnerf.backends.numba.vector.maths import bits_of, broadcast, ceil, floor, lane_numbers, maximum, minimum, select, to_float32
from efficientnerf.backends.numba.vector.memory import advanced, load, store

MARGIN = 1 / 16  # voxels that rounding may put the ends of a ray outside of the grid


@numba.njit(cache=True, inline="always", error_model="numpy")
def _near_and_far(o, d, inverse, most, t0, t1):
    """Distances t0 and t1 between which rays are in a box, and between 0 and `most` along an axis too; exit before entry where they never are."""
    moves, low, high = (d != 0.0), o * -1.0 * inverse, (most - o) * inverse
    within = select((o >= 0.0) & (o <= most), t1, -1.0)
    return select(moves, maximum(t0, minimum(low, high)), t0), select(moves, minimum(t1, maximum(low, high)), within)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _in_box(x, y, z, nx, ny, nz):
    """Which points lie in the box from 0 to (nx, ny, nz), but for rounding; what is not finite does not."""
    inside = (x >= -MARGIN) & (x <= nx + MARGIN) & (y >= -MARGIN) & (y <= ny + MARGIN)
    return inside & (z >= -MARGIN) & (z <= nz + MARGIN)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _origins(ratio, shift_x, shift_y, shift_z, rays, places):
    """Where rays begin, voxel coordinates of a cascade."""
    if rays.kind == PINHOLE:
        return broadcast(rays.x / ratio + shift_x, LANES), broadcast(rays.y / ratio + shift_y, LANES), broadcast(rays.z / ratio + shift_z, LANES)
    x, y, z = load(places, ORIGIN, LANES), load(places, ORIGIN + LANES, LANES), load(places, ORIGIN + 2 * LANES, LANES)
    return x / ratio + shift_x, y / ratio + shift_y, z / ratio + shift_z


@numba.njit(cache=True, error_model="numpy")
def _lay_out_pinhole(tile, rays, floats, places):
    """Directions and cosines of a pinhole camera's rays."""
    across, lane = np.float64(tile.last - tile.first), lane_numbers(LANES)
    row = floor((lane + 0.5) / across)
    x = (lane - row * across + np.float64(tile.first) + 0.5) * rays.pitch
    y = (row + np.float64(rays.first_row + tile.upper) + 0.5) * rays.pitch
    dx, dy, dz, cosine = pinhole_direction(x, y, rays)
    store(places, DIRECTION, dx)
    store(places, DIRECTION + LANES, dy)
    store(places, DIRECTION + 2 * LANES, dz)
    store(places, COSINE, cosine)
    dx, dy, dz = to_float32(dx), to_float32(dy), to_float32(dz)
    store(floats, ALONG_X, dx)
    store(floats, ALONG_Y, dy)
    store(floats, ALONG_Z, dz)
    store(floats, SH_X, dx)
    store(floats, SH_Y, dy)
    store(floats, SH_Z, dz)


@numba.njit(cache=True, error_model="numpy")
def _lay_out_rays(tile, rays, floats, places):
    """Origins, directions and cosines of other rays."""
    row, column = tile.upper, tile.first
    for lane in range((tile.lower - tile.upper) * (tile.last - tile.first)):
        ox, oy, oz, dx, dy, dz, cosine = ray_at(row, column, rays)
        places[ORIGIN + lane], places[ORIGIN + LANES + lane], places[ORIGIN + 2 * LANES + lane], places[COSINE + lane] = ox, oy, oz, cosine
        places[DIRECTION + lane], places[DIRECTION + LANES + lane], places[DIRECTION + 2 * LANES + lane] = dx, dy, dz
        floats[ALONG_X + lane], floats[ALONG_Y + lane], floats[ALONG_Z + lane] = np.float32(dx), np.float32(dy), np.float32(dz)
        floats[SH_X + lane], floats[SH_Y + lane], floats[SH_Z + lane] = np.float32(dx), np.float32(dy), np.float32(dz)
        if rays.has_sh_directions:
            p = 3 * (row * rays.width + column)
            floats[SH_X + lane], floats[SH_Y + lane], floats[SH_Z + lane] = rays.sh_directions[p], rays.sh_directions[p + 1], rays.sh_directions[p + 2]
        column += 1
        if column == tile.last:
            row, column = row + 1, tile.first


@numba.njit(cache=True, error_model="numpy")
def begin_rays(tile, rays, scene, scratch):
    """Lays out the rays of a tile's subdivision, which have met nothing, and where they enter and leave each cascade; returns their number."""
    floats, places, none = scratch.floats, scratch.rays, broadcast(np.float32(0), LANES)
    for n in range(TRANSMITTANCE, BASIS, LANES):
        store(floats, n, none)
    for n in range(0, CACHED, LANES):
        store(scratch.ints, CACHE + n, broadcast(np.int32(-1), LANES))
    scratch.ints[HAS_BASIS] = 0
    store(floats, TRANSMITTANCE, broadcast(np.float32(1), LANES))
    store(floats, HALF_DISTANCE, broadcast(np.float32(np.inf), LANES))
    store(floats, DEPTH, broadcast(np.float32(np.inf), LANES))
    if rays.kind == PINHOLE:
        _lay_out_pinhole(tile, rays, floats, places)
    else:
        _lay_out_rays(tile, rays, floats, places)
    dx, dy, dz = load(places, DIRECTION, LANES), load(places, DIRECTION + LANES, LANES), load(places, DIRECTION + 2 * LANES, LANES)
    per_x, per_y, per_z = 1.0 / dx, 1.0 / dy, 1.0 / dz
    for n in range(scene.cascades):
        grid, place, brick = advanced(scene.grids, 4 * n), advanced(scene.places, 4 * n), scene.base.brick
        x, y, z = _origins(place[0], place[1], place[2], place[3], rays, places)
        t0, t1 = broadcast(0.0, LANES), broadcast(np.inf, LANES)
        t0, t1 = _near_and_far(x, dx, per_x, np.float64(grid[0] * brick), t0, t1)
        t0, t1 = _near_and_far(y, dy, per_y, np.float64(grid[1] * brick), t0, t1)
        t0, t1 = _near_and_far(z, dz, per_z, np.float64(grid[2] * brick), t0, t1)
        store(places, ENDS + 2 * LANES * n, t0)
        store(places, ENDS + 2 * LANES * n + LANES, t1)
    return (tile.lower - tile.upper) * (tile.last - tile.first)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _part_of(part, places):
    """Distances at which rays' parts in a cascade begin and end, voxels of it: see `efficientnerf.asset.rendering.ray_parts`."""
    at = ENDS + 2 * LANES * abs(part)
    t0, t1 = load(places, at, LANES), load(places, at + LANES, LANES)
    if part != 0:
        # Voxels of the cascade before are half as large.
        enter, leave = load(places, at - 2 * LANES, LANES), load(places, at - LANES, LANES)
        if part < 0:
            t1 = select(leave > enter, enter / 2.0, t1)
        else:
            t0 = select(leave > enter, leave / 2.0, t1)
    return t0, t1


@numba.njit(cache=True, error_model="numpy")
def begin_part(part, count, clear, grid, step, rays, scratch):
    """Lays out the parts of rays in a cascade, their beginnings rounded to float32 as the samples are; returns whether there are any."""
    floats, places, none = scratch.floats, scratch.rays, np.float32(0)
    nx, ny, nz = np.float64(grid.nx * grid.brick), np.float64(grid.ny * grid.brick), np.float64(grid.nz * grid.brick)
    t0, t1 = _part_of(part, places)
    some = (lane_numbers(LANES) < np.float64(count)) & (load(floats, TRANSMITTANCE, LANES) >= np.float32(PACKED_EARLY_STOP)) & (t1 > t0)
    t0, t1 = select(some, t0, 0.0), select(some, t1, 0.0)
    last = ceil(minimum((t1 - t0) / step - 0.5, np.float64(most_samples(grid.nx * grid.brick, grid.ny * grid.brick, grid.nz * grid.brick, step))))
    dx, dy, dz = load(places, DIRECTION, LANES), load(places, DIRECTION + LANES, LANES), load(places, DIRECTION + 2 * LANES, LANES)
    ox, oy, oz = _origins(grid.ratio, grid.shift_x, grid.shift_y, grid.shift_z, rays, places)
    # From so far away that rounding hides the grid nothing is seen: samples, which go on from the first, would lie beside the bricks.
    s = maximum(last - 0.5, 0.0) * step
    x, y, z = ox + t0 * dx, oy + t0 * dy, oz + t0 * dz
    some = some & _in_box(x, y, z, nx, ny, nz) & _in_box(x + s * dx, y + s * dy, z + s * dz, nx, ny, nz)
    begin, last = floor(minimum(maximum((clear - t0) / step - 0.5, 0.0), last)), select(some, last, 0.0)
    begin = select(some, begin, 0.0)
    store(floats, ENTRY_X, select(some, to_float32(x), none))
    store(floats, ENTRY_Y, select(some, to_float32(y), none))
    store(floats, ENTRY_Z, select(some, to_float32(z), none))
    store(floats, FIRST, to_float32(begin))
    store(floats, LAST, to_float32(last))
    store(places, BEGIN, t0)
    return bits_of(begin < last) != 0
