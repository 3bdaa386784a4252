"""Images from packed trees (numba): rays of a camera, or given rays, in tiles of neighbours."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.simd import advanced, pointer
from efficientnerf.backends.numba.tree.blocks import QUEUE, Pool
from efficientnerf.backends.numba.tree.march import (
    COLOUR,
    HALF_DISTANCE,
    INTERPOLATED,
    LOOKUPS,
    PACKED_EARLY_STOP,
    STEP,
    TESTED,
    TRANSMITTANCE,
    VISITED,
    Ray,
    RayScratch,
    begin_ray,
    march,
)
from efficientnerf.backends.numba.tree.normals import normal_into
from efficientnerf.backends.numba.tree.ray_batch import clear_distance, in_cascade, ray_at, ray_pointers
from efficientnerf.backends.numba.tree.view_colours import PackedPointers, View, packed_pointers
from efficientnerf.backends.numba.tree.walk import most_samples

TILE = 8  # rays along each side of a tile
SUBTILE = 4  # rays along each side of a subdivision of one
RUNS = 32  # rectangles of neighbouring tiles per thread
WORK = 2**25  # of a thread in one call, about 0.2 s: samples tested, and what is counted as so many of them
INTERPOLATION, LOOKUP = 8, 32
ALL_RUNS = 2**62  # as the run that a thread goes on with: it is done
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
    """Working memory for the rays of a tile, arrays as pointers: that of `march`; a ray's result and normal; and by cascade, in its voxels, the distances (L,)
    up to which the subdivision is clear and up to which the tile is, negative where that is not known yet, and those at which a ray enters and leaves the box.
    """

    ray: RayScratch
    result: Any
    normal: Any
    clear: Any
    known: Any
    enter: Any
    leave: Any


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
        scene.places[4 * n + 3], advanced(base.leap, first), base.has_density, base.mask_words, base.stored_ranks, base.rank_words, base.bricks, base.cells,
        advanced(base.brick_index, first), base.voxel_index, base.density, base.terms, base.coded, base.sh, base.base, base.base_table, base.codes, base.groups,
        base.palette, base.entries, base.code_columns,
    )  # fmt: skip
    return grid, View(advanced(scene.direction, 12 * n), scene.direction_rate, scene.min_distance[n], scene.density_scale[n], scene.degree)


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
def _render_part(t0, t1, clear, origin, direction, sh_direction, grid, view, pool, scratch):  # type: ignore[no-untyped-def]
    """Adds what a ray meets from t0 to t1, voxels of the grid, to its state; returns its beginning (x, y, z), rounded to float32 as the samples are."""
    ox, oy, oz = origin
    dx, dy, dz = direction
    nx, ny, nz = grid.nx * grid.brick, grid.ny * grid.brick, grid.nz * grid.brick
    last = int(np.ceil(min((t1 - t0) / STEP - 0.5, most_samples(nx, ny, nz)))) if t1 > t0 else 0
    # From so far away that rounding hides the grid nothing is seen: samples, which go on from the first, would lie beside the blocks.
    s = max(last - 0.5, 0.0) * STEP
    x, y, z = ox + t0 * dx, oy + t0 * dy, oz + t0 * dz
    if not (_in_box(x, y, z, nx, ny, nz) and _in_box(x + s * dx, y + s * dy, z + s * dz, nx, ny, nz)):
        last = 0
    begin = int(min(max((clear - t0) / STEP - 0.5, 0.0), last))
    ex, ey, ez = np.float32(ox + t0 * dx), np.float32(oy + t0 * dy), np.float32(oz + t0 * dz)
    ax, ay, az = np.float32(dx), np.float32(dy), np.float32(dz)
    march(Ray(ex, ey, ez, ax, ay, az, sh_direction[0], sh_direction[1], sh_direction[2]), begin, last, grid, view, pool, scratch.ray)
    return ex, ey, ez


@numba.njit(cache=True, error_model="numpy")
def _render_ray(row, column, tile, rays, scene, pool, scratch, result, normal):  # type: ignore[no-untyped-def]
    """Renders a ray into result (9,), red, green, blue, opacity, depth from the origin in voxels of cascade 0, and statistics, see `render_batch`; and the
    normal where its depth is into (3,).

    Its parts in the cascades, from front to back: see `efficientnerf.asset.rendering.ray_parts`.
    """
    ox, oy, oz, dx, dy, dz, cosine = ray_at(row, column, rays)
    sh_x, sh_y, sh_z = np.float32(dx), np.float32(dy), np.float32(dz)
    if rays.has_sh_directions:
        p = 3 * (row * rays.width + column)
        sh_x, sh_y, sh_z = rays.sh_directions[p], rays.sh_directions[p + 1], rays.sh_directions[p + 2]
    state, enter, leave, cascades = scratch.ray.state, scratch.enter, scratch.leave, scene.cascades
    begin_ray(scratch.ray)
    result[4] = np.float32(np.inf)
    normal[0] = normal[1] = normal[2] = np.float32(0)
    for n in range(cascades):
        grid, _ = _cascade(n, scene)
        x, y, z = in_cascade(ox, oy, oz, grid)
        enter[n], leave[n] = _intersect_box(x, y, z, dx, dy, dz, grid.nx * grid.brick, grid.ny * grid.brick, grid.nz * grid.brick)
    for part in range(1 - cascades, cascades):
        n = abs(part)
        t0, t1 = enter[n], leave[n]
        if n > 0:
            # Voxels of the cascade before are half as large.
            meets = leave[n - 1] > enter[n - 1]
            if part < 0 and meets:
                t1 = enter[n - 1] / 2
            elif part > 0:
                t0 = leave[n - 1] / 2 if meets else t1
            if not t1 > t0:
                continue
        clear = scratch.clear[n]
        if clear < 0:
            clear = _clear(n, tile, rays, scene, scratch)
        if clear == np.inf:
            continue
        grid, view = _cascade(n, scene)
        ex, ey, ez = _render_part(t0, t1, clear, in_cascade(ox, oy, oz, grid), (dx, dy, dz), (sh_x, sh_y, sh_z), grid, view, pool, scratch)
        distance = state[HALF_DISTANCE]
        if distance < np.inf and result[4] == np.inf:
            result[4] = (t0 + distance) * grid.ratio * cosine
            normal_into(ex + distance * np.float32(dx), ey + distance * np.float32(dy), ez + distance * np.float32(dz), grid, view, pool, normal)
        if state[TRANSMITTANCE] < np.float32(PACKED_EARLY_STOP):
            break
    result[0], result[1], result[2], result[3] = state[COLOUR + 1], state[COLOUR + 2], state[COLOUR + 3], np.float32(1) - state[TRANSMITTANCE]
    result[5], result[6], result[7], result[8] = state[VISITED], state[TESTED], state[INTERPOLATED], state[LOOKUPS]


@numba.njit(cache=True, inline="always", error_model="numpy")
def _run_size(down, across, threads):  # type: ignore[no-untyped-def]
    """Rows and columns of tiles in a run, a rectangle of them that a thread takes."""
    tiles = down * across // (threads * RUNS)
    tall = min(down, max(1, int(np.sqrt(tiles))))
    return tall, min(across, max(1, tiles // tall))


@numba.njit(cache=True, error_model="numpy")
def _render_tile(top, low, left, right, rays, background, scene, voxel, pool, scratch, outputs, done, work):  # type: ignore[no-untyped-def]
    """Renders rows top to low and columns left to right, but for the first `done` of their rays; returns how many are done, -1 for all, and the work left.

    work  that may be done; ends with the ray that it is spent on
    """
    result, normal = scratch.result, scratch.normal
    ray, filled = 0, pool.next[1]
    for n in range(scene.cascades):
        scratch.known[n] = -1.0
    columns = (right - left + SUBTILE - 1) // SUBTILE
    for part in range((low - top + SUBTILE - 1) // SUBTILE * columns):
        upper, first = top + part // columns * SUBTILE, left + part % columns * SUBTILE
        lower, last = min(upper + SUBTILE, low), min(first + SUBTILE, right)
        tile = Tile(top, low, left, right, upper, lower, first, last)
        for n in range(scene.cascades):
            scratch.clear[n] = -1.0
        clear = _all_clear(tile, rays, scene, scratch)
        for row in range(upper, lower):
            for column in range(first, last):
                ray += 1
                if ray <= done:
                    continue
                if clear:
                    for m in range(9):
                        result[m] = np.float32(0)
                    result[4] = np.float32(np.inf)
                    normal[0] = normal[1] = normal[2] = np.float32(0)
                else:
                    _render_ray(row, column, tile, rays, scene, pool, scratch, result, normal)
                pixel = row * outputs.width + column
                transmittance = np.float32(1) - result[3]
                for c in range(3):
                    outputs.colour[3 * pixel + c] = result[c] + transmittance * background[c]
                    if outputs.with_normal:
                        outputs.normal[3 * pixel + c] = normal[c]
                outputs.opacity[pixel], outputs.depth[pixel] = result[3], result[4] * voxel
                if outputs.with_statistics:
                    for m in range(4):
                        outputs.statistics[4 * pixel + m] = np.int32(result[5 + m])
                work -= np.int64(1 + result[5] + result[6] + INTERPOLATION * result[7] + LOOKUP * result[8]) + pool.next[1] - filled
                filled = pool.next[1]
                if work <= 0:
                    return ray, work
    return -1, work


@numba.njit(cache=True, error_model="numpy")
def _render_runs(worker, threads, budget, progress, height, tile, rays, background, scene, voxel, pool, scratch, outputs):  # type: ignore[no-untyped-def]
    """Renders a thread's share of an image from where `progress` says, see `render_batch`, until it is done or the budget is spent.

    Each thread takes runs of tiles from all over the image, for tiles of background are cheap; neighbouring tiles share bricks.
    """
    width, work = outputs.width, np.int64(budget)
    down, across = (height + tile[0] - 1) // tile[0], (width + tile[1] - 1) // tile[1]
    tall, wide = _run_size(down, across, threads)
    columns = (across + wide - 1) // wide
    for run in range(progress[worker, 0], (down + tall - 1) // tall * columns):
        # Neighbouring runs, along rows and columns, go to different threads.
        if (run // columns + run % columns) % threads != worker:
            continue
        for n in range(progress[worker, 1] if run == progress[worker, 0] else 0, tall * wide):
            row, column = run // columns * tall + n // wide, run % columns * wide + n % wide
            if row < down and column < across:
                top, left = row * tile[0], column * tile[1]
                low, right = min(top + tile[0], height), min(left + tile[1], width)
                done = progress[worker, 2] if run == progress[worker, 0] and n == progress[worker, 1] else 0
                done, work = _render_tile(top, low, left, right, rays, background, scene, voxel, pool, scratch, outputs, done, work)
                if work <= 0:
                    progress[worker, 0], progress[worker, 1], progress[worker, 2] = run, n if done >= 0 else n + 1, max(done, 0)
                    return
    progress[worker, 0] = ALL_RUNS


@numba.njit(cache=True, parallel=True, error_model="numpy")
def render_batch(  # type: ignore[no-untyped-def]
    batch, background, packed, brick, view_colours, views, voxel, tile, threads, blocks, budget, progress,
    colour, opacity, depth, normal, statistics,
):  # fmt: skip
    """Renders a RayBatch, or as much of it as each thread's budget allows; returns whether that was all.

    background     (3,) float32 colour to composite over
    packed         see `Packed`
    view_colours   (N + 1, 4) float32: see `compute_view_colours`; not read where distances of the views are infinity
    views          see `Views`
    voxel          size of a voxel of cascade 0, world units
    tile           (rows, columns) of a tile
    blocks         in a thread's pool
    budget         of a thread's work, see WORK
    progress       (threads, 3) int64, zero at first: the run, the tile in it and the ray in that which a thread goes on with
    colour         (H, W, 3) float32
    opacity        (H, W) float32
    depth          (H, W) float32, world units: along the view axis for a camera, along the ray for given rays
    normal         (H, W, 3) float32, or (0, 0, 3) where none is wanted
    statistics     (H, W, 4) int32, or (0, 0, 4): coarse cells visited, samples tested, samples interpolated, colours looked up
    """
    # numba removes writes to arrays that come out of a tuple argument: outputs are arguments of their own.
    height, width = opacity.shape
    bricks, size = len(packed.cells), 4 * (brick + 2) ** 3
    slot_of, brick_of = np.full((threads, bricks), -1, np.int32), np.full((threads, blocks), -1, np.int32)
    kind, integers = np.zeros((threads, blocks), np.uint8), np.zeros((threads, 16), np.int64)
    values, voxels = np.empty((threads, (blocks + 1) * size), np.float32), np.empty((threads, size // 4), np.int32)
    floats, ints = np.zeros((threads, 256), np.float32), values.view(np.int32)
    distances = np.zeros((threads, 4, len(packed.grids)))
    for worker in numba.prange(threads):
        values[worker, blocks * size :] = 0
        integers[worker, 8 : 8 + QUEUE] = blocks * size
        pool = Pool(
            size,
            blocks,
            pointer(slot_of[worker]),
            pointer(brick_of[worker]),
            pointer(kind[worker]),
            pointer(integers[worker, :8]),
            pointer(values[worker]),
            pointer(ints[worker]),
            pointer(view_colours),
            len(view_colours) - 1,
            pointer(voxels[worker]),
            pointer(integers[worker, 8:]),
        )
        ray_scratch = RayScratch(
            pointer(floats[worker, 32:48]),
            pointer(floats[worker, 48:64]),
            pointer(floats[worker, 64:80]),
            pointer(floats[worker, 80:96]),
            pointer(floats[worker, 96:128]),
            pointer(floats[worker, 128:160]),
        )
        clear, known, enter, leave = distances[worker, 0], distances[worker, 1], distances[worker, 2], distances[worker, 3]
        scratch = TileScratch(
            ray_scratch, pointer(floats[worker, 160:192]), pointer(floats[worker, 192:]), pointer(clear), pointer(known), pointer(enter), pointer(leave)
        )
        outputs = Outputs(width, pointer(colour), pointer(opacity), pointer(depth), pointer(normal), pointer(statistics), len(normal) > 0, len(statistics) > 0)
        rays = ray_pointers(batch)
        scene = Scene(
            len(packed.grids), packed_pointers(packed, brick, 0), pointer(packed.grids), pointer(packed.places), pointer(views.direction),
            views.direction_rate, pointer(views.min_distance), pointer(views.density_scale), views.degree,
        )  # fmt: skip
        _render_runs(worker, threads, budget, progress, height, tile, rays, background, scene, voxel, pool, scratch, outputs)
    left = 0
    for worker in range(threads):
        left += progress[worker, 0] != ALL_RUNS
    return left == 0


@numba.njit(cache=True, parallel=True, error_model="numpy")
def downsample(supersample, fine_colour, fine_opacity, fine_depth, fine_normal, colour, opacity, depth, normal):  # type: ignore[no-untyped-def]
    """Pixels from their supersample^2 rays: mean colour and opacity, median depth, mean normal.

    The median is over all rays, those without a hit last; a mean of the depths of two surfaces would lie on neither.
    """
    count = supersample * supersample
    one = np.float32(1 / count)
    for row in numba.prange(opacity.shape[0]):
        sorted_depth = np.empty(count, np.float32)
        for column in range(opacity.shape[1]):
            r = g = b = o = x = y = z = np.float32(0)
            hits = 0
            for n in range(count):
                i, j = row * supersample + n // supersample, column * supersample + n % supersample
                r += fine_colour[i, j, 0]
                g += fine_colour[i, j, 1]
                b += fine_colour[i, j, 2]
                o += fine_opacity[i, j]
                if len(normal) > 0:
                    x += fine_normal[i, j, 0]
                    y += fine_normal[i, j, 1]
                    z += fine_normal[i, j, 2]
                if fine_depth[i, j] < np.inf:
                    at = hits
                    while at > 0 and sorted_depth[at - 1] > fine_depth[i, j]:
                        sorted_depth[at] = sorted_depth[at - 1]
                        at -= 1
                    sorted_depth[at] = fine_depth[i, j]
                    hits += 1
            colour[row, column, 0], colour[row, column, 1], colour[row, column, 2] = r * one, g * one, b * one
            opacity[row, column] = o * one
            opaque = o * one >= np.float32(0.5) and hits > 0
            # Fewer than half of the rays may hit where others are half transparent.
            depth[row, column] = sorted_depth[min(hits - 1, (count - 1) // 2)] if opaque else np.float32(np.inf)
            if len(normal) > 0:
                length = np.sqrt(x * x + y * y + z * z)
                scale = np.float32(1) / length if opaque and length > 0 else np.float32(0)
                normal[row, column, 0], normal[row, column, 1], normal[row, column, 2] = x * scale, y * scale, z * scale
