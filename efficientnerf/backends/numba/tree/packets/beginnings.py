"""Where the rays of a packet begin and end (numba): their origins and directions, and their parts in each cascade.

All rays of a packet are laid out at once, in lanes of float64.
"""

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.tree.march import PACKED_EARLY_STOP, most_samples
from efficientnerf.backends.numba.tree.packets import layout
from efficientnerf.backends.numba.tree.packets.layout import LANES
from efficientnerf.backends.numba.tree.ray_batch import PINHOLE, pinhole_direction, ray_at
from efficientnerf.backends.numba.vector.maths import bits_of, broadcast, ceil, floor, lane_numbers, maximum, minimum, select, to_float32
from efficientnerf.backends.numba.vector.memory import advanced, load, load_three, store, store_three

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
    x, y, z = load_three(places, layout.ORIGIN, LANES)
    return x / ratio + shift_x, y / ratio + shift_y, z / ratio + shift_z


@numba.njit(cache=True, error_model="numpy")
def _lay_out_pinhole(tile, rays, floats, places):
    """Directions and cosines of a pinhole camera's rays."""
    across, lane = np.float64(tile.last - tile.first), lane_numbers(LANES)
    row = floor((lane + 0.5) / across)
    x = (lane - row * across + np.float64(tile.first) + 0.5) * rays.pitch
    y = (row + np.float64(rays.first_row + tile.upper) + 0.5) * rays.pitch
    dx, dy, dz, cosine = pinhole_direction(x, y, rays)
    store_three(places, layout.DIRECTION, LANES, dx, dy, dz)
    store(places, layout.COSINE, cosine)
    dx, dy, dz = to_float32(dx), to_float32(dy), to_float32(dz)
    store_three(floats, layout.ALONG, LANES, dx, dy, dz)
    store_three(floats, layout.SH_ALONG, LANES, dx, dy, dz)


@numba.njit(cache=True, forceinline=True, error_model="numpy")
def _put(p, at, x, y, z):
    """Three numbers of one ray."""
    p[at], p[at + LANES], p[at + 2 * LANES] = x, y, z


@numba.njit(cache=True, error_model="numpy")
def _lay_out_rays(tile, rays, floats, places):
    """Origins, directions and cosines of other rays."""
    row, column = tile.upper, tile.first
    for lane in range((tile.lower - tile.upper) * (tile.last - tile.first)):
        ox, oy, oz, dx, dy, dz, cosine = ray_at(row, column, rays)
        _put(places, layout.ORIGIN + lane, ox, oy, oz)
        _put(places, layout.DIRECTION + lane, dx, dy, dz)
        places[layout.COSINE + lane] = cosine
        dx, dy, dz = np.float32(dx), np.float32(dy), np.float32(dz)
        _put(floats, layout.ALONG + lane, dx, dy, dz)
        if rays.has_sh_directions:
            p = 3 * (row * rays.width + column)
            dx, dy, dz = rays.sh_directions[p], rays.sh_directions[p + 1], rays.sh_directions[p + 2]
        _put(floats, layout.SH_ALONG + lane, dx, dy, dz)
        column += 1
        if column == tile.last:
            row, column = row + 1, tile.first


@numba.njit(cache=True, error_model="numpy")
def begin_rays(tile, rays, scene, scratch):
    """Lays out the rays of a tile's subdivision, which have met nothing, and where they enter and leave each cascade; returns their number."""
    floats, places, none = scratch.floats, scratch.rays, broadcast(np.float32(0), LANES)
    for n in range(layout.TRANSMITTANCE, layout.BASIS, LANES):
        store(floats, n, none)
    for n in range(0, layout.CACHED, LANES):
        store(scratch.ints, layout.CACHE + n, broadcast(np.int32(-1), LANES))
    scratch.ints[layout.HAS_BASIS] = 0
    store(floats, layout.TRANSMITTANCE, broadcast(np.float32(1), LANES))
    store(floats, layout.HALF_DISTANCE, broadcast(np.float32(np.inf), LANES))
    store(floats, layout.DEPTH, broadcast(np.float32(np.inf), LANES))
    if rays.kind == PINHOLE:
        _lay_out_pinhole(tile, rays, floats, places)
    else:
        _lay_out_rays(tile, rays, floats, places)
    dx, dy, dz = load_three(places, layout.DIRECTION, LANES)
    per_x, per_y, per_z = 1.0 / dx, 1.0 / dy, 1.0 / dz
    for n in range(scene.cascades):
        grid, place, brick = advanced(scene.grids, 4 * n), advanced(scene.places, 4 * n), scene.base.brick
        x, y, z = _origins(place[0], place[1], place[2], place[3], rays, places)
        t0, t1 = broadcast(0.0, LANES), broadcast(np.inf, LANES)
        t0, t1 = _near_and_far(x, dx, per_x, np.float64(grid[0] * brick), t0, t1)
        t0, t1 = _near_and_far(y, dy, per_y, np.float64(grid[1] * brick), t0, t1)
        t0, t1 = _near_and_far(z, dz, per_z, np.float64(grid[2] * brick), t0, t1)
        store(places, layout.ENDS + 2 * LANES * n, t0)
        store(places, layout.ENDS + 2 * LANES * n + LANES, t1)
    return (tile.lower - tile.upper) * (tile.last - tile.first)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _part_of(part, places):
    """Distances at which rays' parts in a cascade begin and end, voxels of it: see `efficientnerf.asset.rendering.ray_parts`."""
    at = layout.ENDS + 2 * LANES * abs(part)
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
    some = (lane_numbers(LANES) < np.float64(count)) & (load(floats, layout.TRANSMITTANCE, LANES) >= np.float32(PACKED_EARLY_STOP)) & (t1 > t0)
    t0, t1 = select(some, t0, 0.0), select(some, t1, 0.0)
    last = ceil(minimum((t1 - t0) / step - 0.5, np.float64(most_samples(grid.nx * grid.brick, grid.ny * grid.brick, grid.nz * grid.brick, step))))
    dx, dy, dz = load_three(places, layout.DIRECTION, LANES)
    ox, oy, oz = _origins(grid.ratio, grid.shift_x, grid.shift_y, grid.shift_z, rays, places)
    # From so far away that rounding hides the grid nothing is seen: samples, which go on from the first, would lie beside the bricks.
    s = maximum(last - 0.5, 0.0) * step
    x, y, z = ox + t0 * dx, oy + t0 * dy, oz + t0 * dz
    some = some & _in_box(x, y, z, nx, ny, nz) & _in_box(x + s * dx, y + s * dy, z + s * dz, nx, ny, nz)
    begin, last = floor(minimum(maximum((clear - t0) / step - 0.5, 0.0), last)), select(some, last, 0.0)
    begin = select(some, begin, 0.0)
    store_three(floats, layout.ENTRY, LANES, select(some, to_float32(x), none), select(some, to_float32(y), none), select(some, to_float32(z), none))
    store(floats, layout.FIRST, to_float32(begin))
    store(floats, layout.LAST, to_float32(last))
    store(places, layout.BEGIN, t0)
    return bits_of(begin < last) != 0
