"""Tiles of an image, rendered packet by packet of rays (numba): where rays begin and end in each cascade, and what they bring back."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.simd import advanced
from efficientnerf.backends.numba.tree.march import PACKED_EARLY_STOP
from efficientnerf.backends.numba.tree.normals import add_normals
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
    INTERPOLATED,
    LANES,
    LAST,
    LOOKUPS,
    NORMAL_X,
    ORIGIN,
    RED,
    SH_X,
    SH_Y,
    SH_Z,
    TESTED,
    TRANSMITTANCE,
    VISITED,
    X,
    Y,
    Z,
)
from efficientnerf.backends.numba.tree.packets.march import march
from efficientnerf.backends.numba.tree.ray_batch import clear_distance, in_cascade, normal_in_world, ray_at, tile_rays, world_depth
from efficientnerf.backends.numba.tree.view_colours import PackedPointers, View
from efficientnerf.backends.numba.tree.walk import most_samples

INTERPOLATION, LOOKUP = 8, 32  # work of a sample interpolated and of a colour looked up, in samples tested
MARGIN = 1 / 16  # voxels that rounding may put the ends of a ray outside of the grid


class Outputs(NamedTuple):
    """The images that `render_batch` writes, as pointers, and whether the last two are wanted."""

    width: int
    colour: Any
    opacity: Any
    depth: Any
    normal: Any
    statistics: Any
    with_normal: bool
    with_statistics: bool


class Scene(NamedTuple):
    """All cascades of a packed tree, and the views of them, with arrays as pointers; see `Packed` and `Views`. `base` is cascade 0."""

    cascades: int
    base: PackedPointers
    grids: Any
    places: Any
    direction: Any
    direction_rate: float
    min_distance: Any
    density_scale: Any
    step: float
    degree: int


class Tile(NamedTuple):
    """Rows top to low and columns left to right, and the subdivision of it that is being rendered, rows upper to lower and columns first to last."""

    top: int
    low: int
    left: int
    right: int
    upper: int
    lower: int
    first: int
    last: int


class TileScratch(NamedTuple):
    """Working memory for the rays of a tile, arrays as pointers: numbers of a packet of rays as in `layout`, float32, int32 and float64; and by cascade, in its
    voxels, the distances (L,) up to which the subdivision is clear and up to which the tile is, negative where that is not known yet; and what `tile_rays`
    writes.
    """

    floats: Any
    ints: Any
    rays: Any
    clear: Any
    known: Any
    warped: Any
    looking: Any


@numba.njit(cache=True, error_model="numpy")
def _intersect_box(ox, oy, oz, dx, dy, dz, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Distances at which a ray enters and leaves the box from 0 to (nx, ny, nz), at least 0; exit before entry where it misses."""
    t0, t1 = 0.0, np.inf
    if dx != 0:
        inverse = 1 / dx
        t_low, t_high = -ox * inverse, (nx - ox) * inverse
        t0, t1 = max(t0, min(t_low, t_high)), min(t1, max(t_low, t_high))
    elif not 0 <= ox <= nx:
        t1 = -1.0
    if dy != 0:
        inverse = 1 / dy
        t_low, t_high = -oy * inverse, (ny - oy) * inverse
        t0, t1 = max(t0, min(t_low, t_high)), min(t1, max(t_low, t_high))
    elif not 0 <= oy <= ny:
        t1 = -1.0
    if dz != 0:
        inverse = 1 / dz
        t_low, t_high = -oz * inverse, (nz - oz) * inverse
        t0, t1 = max(t0, min(t_low, t_high)), min(t1, max(t_low, t_high))
    elif not 0 <= oz <= nz:
        t1 = -1.0
    return t0, t1


@numba.njit(cache=True, inline="always", error_model="numpy")
def _in_box(x, y, z, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Whether a point lies in the box from 0 to (nx, ny, nz), but for rounding; what is not finite does not."""
    return -MARGIN <= x <= nx + MARGIN and -MARGIN <= y <= ny + MARGIN and -MARGIN <= z <= nz + MARGIN


@numba.njit(cache=True, inline="always", error_model="numpy")
def _cascade(n, scene):  # type: ignore[no-untyped-def]
    """Cascade n of a scene as PackedPointers, and the View of it."""
    base, first = scene.base, scene.grids[4 * n + 3]
    grid = PackedPointers(
        base.brick, scene.grids[4 * n], scene.grids[4 * n + 1], scene.grids[4 * n + 2], scene.places[4 * n], scene.places[4 * n + 1], scene.places[4 * n + 2],
        scene.places[4 * n + 3], advanced(base.leap, first), advanced(base.octants, first * 8 if base.directed else first), base.directed, base.has_density,
        base.mask_words, base.rows, base.narrow, base.voxels, base.voxel_of, advanced(base.brick_index, first), base.density, base.terms, base.coded,
        base.sh, base.base, base.base_table, base.codes, base.groups, base.palette, base.entries, base.code_columns,
    )  # fmt: skip
    return grid, View(advanced(scene.direction, 12 * n), scene.direction_rate, scene.min_distance[n], scene.density_scale[n], scene.step, scene.degree)


@numba.njit(cache=True, error_model="numpy")
def _clear(n, tile, rays, scene, scratch):  # type: ignore[no-untyped-def]
    """Distance, voxels of cascade n, up to which the rays of a tile's subdivision are clear in it; worked out when first asked for."""
    if scratch.clear[n] < 0:
        grid, _ = _cascade(n, scene)
        if scratch.known[n] < 0:
            scratch.known[n] = clear_distance(tile.top, tile.low, tile.left, tile.right, 0.0, rays, grid)
        known = scratch.known[n]
        scratch.clear[n] = clear_distance(tile.upper, tile.lower, tile.first, tile.last, known, rays, grid) if known < np.inf else known
    return scratch.clear[n]


@numba.njit(cache=True, error_model="numpy")
def _all_clear(tile, rays, scene, scratch):  # type: ignore[no-untyped-def]
    """Whether the rays of a tile's subdivision meet nothing."""
    n = 0
    while n < scene.cascades and _clear(n, tile, rays, scene, scratch) == np.inf:
        n += 1
    return n == scene.cascades


@numba.njit(cache=True, inline="always", error_model="numpy")
def _packet_size(top, low):  # type: ignore[no-untyped-def]
    """Rows and columns of the subdivisions of a tile."""
    return (1, LANES) if low - top == 1 else (4, LANES // 4)


@numba.njit(cache=True, error_model="numpy")
def _begin_rays(tile, rays, scene, scratch):  # type: ignore[no-untyped-def]
    """Lays out the rays of a tile's subdivision, which have met nothing, and where they enter and leave each cascade; returns their number."""
    floats, places = scratch.floats, scratch.rays
    for n in range(TRANSMITTANCE, BASIS):
        floats[n] = np.float32(0)
    for n in range(CACHED):
        scratch.ints[CACHE + n] = -1
    scratch.ints[HAS_BASIS] = 0
    count = (tile.lower - tile.upper) * (tile.last - tile.first)
    row, column = tile.upper, tile.first
    for lane in range(count):
        ox, oy, oz, dx, dy, dz, cosine = ray_at(row, column, rays)
        places[ORIGIN + lane], places[ORIGIN + LANES + lane], places[ORIGIN + 2 * LANES + lane], places[COSINE + lane] = ox, oy, oz, cosine
        places[DIRECTION + lane], places[DIRECTION + LANES + lane], places[DIRECTION + 2 * LANES + lane] = dx, dy, dz
        floats[ALONG_X + lane], floats[ALONG_Y + lane], floats[ALONG_Z + lane] = np.float32(dx), np.float32(dy), np.float32(dz)
        floats[SH_X + lane], floats[SH_Y + lane], floats[SH_Z + lane] = np.float32(dx), np.float32(dy), np.float32(dz)
        if rays.has_sh_directions:
            p = 3 * (row * rays.width + column)
            floats[SH_X + lane], floats[SH_Y + lane], floats[SH_Z + lane] = rays.sh_directions[p], rays.sh_directions[p + 1], rays.sh_directions[p + 2]
        floats[TRANSMITTANCE + lane] = np.float32(1)
        floats[HALF_DISTANCE + lane] = floats[DEPTH + lane] = np.float32(np.inf)
        for n in range(scene.cascades):
            nx, ny, nz = scene.grids[4 * n] * scene.base.brick, scene.grids[4 * n + 1] * scene.base.brick, scene.grids[4 * n + 2] * scene.base.brick
            ratio, at = scene.places[4 * n], ENDS + 2 * LANES * n + lane
            x, y, z = ox / ratio + scene.places[4 * n + 1], oy / ratio + scene.places[4 * n + 2], oz / ratio + scene.places[4 * n + 3]
            places[at], places[at + LANES] = _intersect_box(x, y, z, dx, dy, dz, nx, ny, nz)
        column += 1
        if column == tile.last:
            row, column = row + 1, tile.first
    return count


@numba.njit(cache=True, inline="always", error_model="numpy")
def _part_of(part, lane, places):  # type: ignore[no-untyped-def]
    """Distances at which a ray's part in a cascade begins and ends, voxels of it: see `efficientnerf.asset.rendering.ray_parts`."""
    n = abs(part)
    at = ENDS + 2 * LANES * n + lane
    t0, t1 = places[at], places[at + LANES]
    if n > 0:
        # Voxels of the cascade before are half as large.
        enter, leave = places[at - 2 * LANES], places[at - LANES]
        if part < 0 and leave > enter:
            t1 = enter / 2
        elif part > 0:
            t0 = leave / 2 if leave > enter else t1
    return t0, t1


@numba.njit(cache=True, error_model="numpy")
def _begin_part(part, count, clear, grid, step, scratch):  # type: ignore[no-untyped-def]
    """Lays out the parts of rays in a cascade, their beginnings rounded to float32 as the samples are; returns whether there are any."""
    floats, places, some = scratch.floats, scratch.rays, False
    nx, ny, nz = grid.nx * grid.brick, grid.ny * grid.brick, grid.nz * grid.brick
    most = most_samples(nx, ny, nz, step)
    for lane in range(LANES):
        floats[FIRST + lane] = floats[LAST + lane] = np.float32(0)
        if lane >= count or floats[TRANSMITTANCE + lane] < np.float32(PACKED_EARLY_STOP):
            continue
        t0, t1 = _part_of(part, lane, places)
        if not t1 > t0:
            continue
        last = int(np.ceil(min((t1 - t0) / step - 0.5, most)))
        dx, dy, dz = places[DIRECTION + lane], places[DIRECTION + LANES + lane], places[DIRECTION + 2 * LANES + lane]
        ox, oy, oz = in_cascade(places[ORIGIN + lane], places[ORIGIN + LANES + lane], places[ORIGIN + 2 * LANES + lane], grid)
        # From so far away that rounding hides the grid nothing is seen: samples, which go on from the first, would lie beside the bricks.
        s = max(last - 0.5, 0.0) * step
        x, y, z = ox + t0 * dx, oy + t0 * dy, oz + t0 * dz
        if not (_in_box(x, y, z, nx, ny, nz) and _in_box(x + s * dx, y + s * dy, z + s * dz, nx, ny, nz)):
            continue
        begin = int(min(max((clear - t0) / step - 0.5, 0.0), last))
        floats[ENTRY_X + lane], floats[ENTRY_Y + lane], floats[ENTRY_Z + lane] = np.float32(x), np.float32(y), np.float32(z)
        floats[FIRST + lane], floats[LAST + lane], places[BEGIN + lane] = np.float32(begin), np.float32(last), t0
        some = some or begin < last
    return some


@numba.njit(cache=True, error_model="numpy")
def _end_part(count, grid, with_normal, scratch):  # type: ignore[no-untyped-def]
    """Depths, voxels of cascade 0, and normals of the rays that lost half of their light in a part."""
    floats, places, found = scratch.floats, scratch.rays, np.int64(0)
    for lane in range(count):
        distance = floats[HALF_DISTANCE + lane]
        if distance < np.inf and floats[DEPTH + lane] == np.inf:
            floats[DEPTH + lane] = (places[BEGIN + lane] + distance) * grid.ratio * places[COSINE + lane]
            floats[X + lane] = floats[ENTRY_X + lane] + distance * floats[ALONG_X + lane]
            floats[Y + lane] = floats[ENTRY_Y + lane] + distance * floats[ALONG_Y + lane]
            floats[Z + lane] = floats[ENTRY_Z + lane] + distance * floats[ALONG_Z + lane]
            found |= np.int64(1) << lane
    if with_normal and found != 0:
        add_normals(found, X, Y, Z, grid, floats)


@numba.njit(cache=True, error_model="numpy")
def _render_packet(tile, rays, scene, colours, with_normal, scratch):  # type: ignore[no-untyped-def]
    """Renders the rays of a tile's subdivision, their parts in the cascades from front to back; what they met is in `scratch`."""
    count = _begin_rays(tile, rays, scene, scratch)
    for part in range(1 - scene.cascades, scene.cascades):
        n = abs(part)
        clear = _clear(n, tile, rays, scene, scratch)
        if clear == np.inf:
            continue
        grid, view = _cascade(n, scene)
        if _begin_part(part, count, clear, grid, scene.step, scratch):
            march(tile.low - tile.top > 1, grid, view, colours, scratch.floats, scratch.ints)
            _end_part(count, grid, with_normal, scratch)


@numba.njit(cache=True, error_model="numpy")
def _unwarp_packet(tile, voxel, rays, scratch, with_normal):  # type: ignore[no-untyped-def]
    """Depths and normals of the warped rays of a tile's subdivision as those of the world, world units."""
    lane, floats = 0, scratch.floats
    for row in range(tile.upper, tile.lower):
        begin = (row - tile.top) * (tile.right - tile.left) - tile.left
        for n in range(begin + tile.first, begin + tile.last):
            if floats[DEPTH + lane] < np.inf:
                along, x, y, z = floats[DEPTH + lane] * voxel, NORMAL_X + lane, NORMAL_X + LANES + lane, NORMAL_X + 2 * LANES + lane
                floats[DEPTH + lane] = world_depth(n, along, scratch.warped)
                if with_normal:
                    floats[x], floats[y], floats[z] = normal_in_world(n, along, floats[x], floats[y], floats[z], rays.ndc, scratch.warped)
            lane += 1


@numba.njit(cache=True, error_model="numpy")
def _write_packet(tile, clear, background, voxel, rays, scratch, outputs):  # type: ignore[no-untyped-def]
    """Writes the pixels of a tile's subdivision, of which those that are `clear` met nothing; returns the work that they were."""
    lane, work, floats = 0, np.int64(0), scratch.floats
    if rays.warped and not clear:
        _unwarp_packet(tile, voxel, rays, scratch, outputs.with_normal)
    for row in range(tile.upper, tile.lower):
        for pixel in range(row * outputs.width + tile.first, row * outputs.width + tile.last):
            transmittance = np.float32(1) if clear else floats[TRANSMITTANCE + lane]
            for c in range(3):
                outputs.colour[3 * pixel + c] = (np.float32(0) if clear else floats[RED + LANES * c + lane]) + transmittance * background[c]
                if outputs.with_normal:
                    outputs.normal[3 * pixel + c] = np.float32(0) if clear else floats[NORMAL_X + LANES * c + lane]
            outputs.opacity[pixel] = np.float32(1) - transmittance
            outputs.depth[pixel] = np.float32(np.inf) if clear else floats[DEPTH + lane] * (np.float32(1) if rays.warped else voxel)
            if outputs.with_statistics:
                for m in range(4):
                    outputs.statistics[4 * pixel + m] = np.int32(0 if clear else floats[VISITED + LANES * m + lane])
            if not clear:
                samples = INTERPOLATION * floats[INTERPOLATED + lane] + LOOKUP * floats[LOOKUPS + lane]
                work += np.int64(floats[VISITED + lane] + floats[TESTED + lane] + samples)
            lane += 1
    return work + lane


@numba.njit(cache=True, error_model="numpy")
def render_tile(top, low, left, right, batch, background, scene, colours, voxel, scratch, outputs, done, work):  # type: ignore[no-untyped-def]
    """Renders rows top to low and columns left to right, but for their first `done` subdivisions; returns how many are done, -1 for all, and the work left.

    work  that may be done; ends with the subdivision that it is spent on
    """
    for n in range(scene.cascades):
        scratch.known[n] = -1.0
    rays = tile_rays(top, low, left, right, batch, scratch.warped, scratch.looking)
    down, across = _packet_size(top, low)
    columns = (right - left + across - 1) // across
    parts = (low - top + down - 1) // down * columns
    for part in range(done, parts):
        upper, first = top + part // columns * down, left + part % columns * across
        tile = Tile(top, low, left, right, upper, min(upper + down, low), first, min(first + across, right))
        for n in range(scene.cascades):
            scratch.clear[n] = -1.0
        clear = _all_clear(tile, rays, scene, scratch)
        if not clear:
            _render_packet(tile, rays, scene, colours, outputs.with_normal, scratch)
        work -= _write_packet(tile, clear, background, voxel, rays, scratch, outputs)
        if work <= 0:
            return part + 1 if part + 1 < parts else -1, work
    return -1, work
