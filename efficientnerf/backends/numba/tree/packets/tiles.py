"""Tiles of an image, rendered packet by packet of rays (numba): where rays begin and end in each cascade, and what they bring back."""

from typing import Any, NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.tree.normals import add_normals
from efficientnerf.backends.numba.tree.packets import layout
from efficientnerf.backends.numba.tree.packets.beginnings import begin_part, begin_rays
from efficientnerf.backends.numba.tree.packets.layout import LANES
from efficientnerf.backends.numba.tree.packets.march import march
from efficientnerf.backends.numba.tree.packets.pixels import write_clear, write_packet
from efficientnerf.backends.numba.tree.ray_batch import PINHOLE, clear_distance, tile_rays
from efficientnerf.backends.numba.tree.view_colours import PackedPointers, View
from efficientnerf.backends.numba.vector.memory import advanced


class Scene(NamedTuple):
    """All cascades of a packed tree, of which `base` is the first, and the views of all, with arrays as pointers; see `Packed`."""

    cascades: int
    base: PackedPointers
    grids: Any
    places: Any
    views: View


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
    voxels, the distances (L,) up to which the subdivision is clear, up to which the tile is, and up to which the block of tiles around it is, negative where
    that is not known yet; and what `tile_rays` writes.
    """

    floats: Any
    ints: Any
    rays: Any
    clear: Any
    known: Any
    block: Any
    warped: Any
    looking: Any


@numba.njit(cache=True, inline="always", error_model="numpy")
def _cascade(n, scene):
    """Cascade n of a scene as PackedPointers, and the View of it."""
    base, first = scene.base, scene.grids[4 * n + 3]
    grid = PackedPointers(
        base.brick, scene.grids[4 * n], scene.grids[4 * n + 1], scene.grids[4 * n + 2], scene.places[4 * n], scene.places[4 * n + 1], scene.places[4 * n + 2],
        scene.places[4 * n + 3], advanced(base.leap, first), advanced(base.octants, first * 8 if base.directed else first), base.directed, base.has_density,
        base.mask_words, base.rows, base.narrow, base.voxels, base.voxel_of, advanced(base.brick_index, first), base.density, base.terms, base.coded,
        base.sh, base.base, base.base_table, base.codes, base.groups, base.palette, base.entries, base.code_columns,
    )  # fmt: skip
    view = scene.views
    return grid, View(advanced(view.direction, 12 * n), view.direction_rate, view.min_distance[n], view.density_scale[n], view.step, view.degree)


@numba.njit(cache=True, error_model="numpy")
def clear_block(top, low, left, right, rays, scene, scratch):
    """Works out how far the rays of a block of tiles are clear in each cascade, or says 0 where that takes as long as for each of its tiles; returns whether
    they meet nothing.
    """
    clear = True
    for n in range(scene.cascades):
        grid, _ = _cascade(n, scene)
        scratch.block[n] = clear_distance(top, low, left, right, 0.0, rays, grid) if rays.kind == PINHOLE and not rays.warped else 0.0
        clear = clear and scratch.block[n] == np.inf
    return clear


@numba.njit(cache=True, error_model="numpy")
def _clear(n, tile, rays, scene, scratch):
    """Distance, voxels of cascade n, up to which the rays of a tile's subdivision are clear in it; worked out when first asked for."""
    if scratch.clear[n] < 0:
        grid, _ = _cascade(n, scene)
        if scratch.known[n] < 0:
            block = scratch.block[n]
            scratch.known[n] = clear_distance(tile.top, tile.low, tile.left, tile.right, block, rays, grid) if block < np.inf else block
        known = scratch.known[n]
        scratch.clear[n] = clear_distance(tile.upper, tile.lower, tile.first, tile.last, known, rays, grid) if known < np.inf else known
    return scratch.clear[n]


@numba.njit(cache=True, error_model="numpy")
def _all_clear(tile, rays, scene, scratch):
    """Whether the rays of a tile's subdivision meet nothing."""
    n = 0
    while n < scene.cascades and _clear(n, tile, rays, scene, scratch) == np.inf:
        n += 1
    return n == scene.cascades


@numba.njit(cache=True, inline="always", error_model="numpy")
def _packet_size(top, low):
    """Rows and columns of the subdivisions of a tile."""
    return (1, LANES) if low - top == 1 else (4, LANES // 4)


@numba.njit(cache=True, error_model="numpy")
def _end_part(count, grid, with_normal, scratch):
    """Depths, voxels of cascade 0, and normals of the rays that lost half of their light in a part."""
    floats, places, found = scratch.floats, scratch.rays, np.int64(0)
    for lane in range(count):
        distance = floats[layout.HALF_DISTANCE + lane]
        if distance < np.inf and floats[layout.DEPTH + lane] == np.inf:
            floats[layout.DEPTH + lane] = (places[layout.BEGIN + lane] + distance) * grid.ratio * places[layout.COSINE + lane]
            for n in range(lane, lane + 3 * LANES, LANES):
                floats[layout.PLACE + n] = floats[layout.ENTRY + n] + distance * floats[layout.ALONG + n]
            found |= np.int64(1) << lane
    if with_normal and found != 0:
        add_normals(found, grid, floats)


@numba.njit(cache=True, error_model="numpy")
def _render_packet(tile, rays, scene, colours, with_normal, scratch):
    """Renders the rays of a tile's subdivision, their parts in the cascades from front to back; what they met is in `scratch`."""
    count = begin_rays(tile, rays, scene, scratch)
    for part in range(1 - scene.cascades, scene.cascades):
        n = abs(part)
        clear = _clear(n, tile, rays, scene, scratch)
        if clear == np.inf:
            continue
        grid, view = _cascade(n, scene)
        if begin_part(part, count, clear, grid, scene.views.step, rays, scratch):
            march(tile.low - tile.top > 1, grid, view, colours, scratch.floats, scratch.ints)
            _end_part(count, grid, with_normal, scratch)


@numba.njit(cache=True, error_model="numpy")
def render_tile(top, low, left, right, batch, background, scene, colours, voxel, scratch, outputs, done, work):
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
        if _all_clear(tile, rays, scene, scratch):
            work -= write_clear(tile.upper, tile.lower, tile.first, tile.last, background, outputs)
        else:
            _render_packet(tile, rays, scene, colours, outputs.with_normal, scratch)
            work -= write_packet(tile, background, voxel, rays, scratch, outputs)
        if work <= 0:
            return part + 1 if part + 1 < parts else -1, work
    return -1, work
