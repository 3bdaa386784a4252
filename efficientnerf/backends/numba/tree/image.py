"""Images from packed trees (numba): rays of a camera, or given rays, in tiles of neighbours."""

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.tree.packets.layout import ENDS, FLOATS, INTS, LANES, TILE_RAYS, WARPED
from efficientnerf.backends.numba.tree.packets.pixels import Outputs, write_clear
from efficientnerf.backends.numba.tree.packets.tiles import Scene, TileScratch, clear_block, render_tile
from efficientnerf.backends.numba.tree.view_colours import packed_pointers
from efficientnerf.backends.numba.vector.memory import fetch_add, pointer, pointers

TILE = 8  # rays along each side of a tile
BLOCK = 4  # tiles along each side of a block of them, which a thread takes
BAND = 4  # blocks
WORK = 2**25  # of a thread in one call, about 0.2 s: samples tested, and what is counted as so many of them


@numba.njit(cache=True, inline="always", error_model="numpy")
def _place(block, down, across):
    """Row and column of a block: they are taken column by column of bands of BAND rows, so that those taken one after the other share bricks."""
    upper = block // (BAND * across) * BAND
    tall, n = min(BAND, down - upper), block - upper * across
    return upper + n % tall, n // tall


@numba.njit(cache=True, error_model="numpy")
def _render_blocks(worker, threads, budget, progress, height, tile, rays, background, scene, colours, voxel, scratch, outputs):
    """Renders blocks of an image, which threads take one after the other, from where `progress` says, see `render_batch`, until none is left or the budget is
    spent. Some blocks are of background and cost little.
    """
    width, work, place = outputs.width, np.int64(budget), progress[worker]
    rows, columns = BLOCK * tile[0], BLOCK * tile[1]
    down, across = (height + rows - 1) // rows, (width + columns - 1) // columns
    while place[0] < down * across:
        row, column = _place(place[0], down, across)
        top, left = row * rows, column * columns
        low, right = min(top + rows, height), min(left + columns, width)
        if clear_block(top, low, left, right, rays, scene, scratch):
            work -= write_clear(top, low, left, right, background, outputs)
            place[1] = BLOCK * BLOCK
        while place[1] < BLOCK * BLOCK:
            upper, first = top + place[1] // BLOCK * tile[0], left + place[1] % BLOCK * tile[1]
            if upper < height and first < width:
                lower, last = min(upper + tile[0], height), min(first + tile[1], width)
                place[2], work = render_tile(upper, lower, first, last, rays, background, scene, colours, voxel, scratch, outputs, place[2], work)
                if place[2] >= 0:
                    return
                place[2] = 0
            place[1] += 1
            if work <= 0:
                return
        place[0], place[1] = fetch_add(pointer(progress), 3 * threads, 1), 0


def beginning(threads: int) -> np.ndarray:
    """The `progress` of an image of which nothing is rendered: threads begin with the first blocks."""
    progress = np.zeros((threads + 1, 3), np.int64)
    progress[:, 0] = np.arange(threads + 1)
    return progress


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def render_batch(
    batch, background, packed, brick, view_colours, view, voxel, tile, threads, budget, progress,
    colour, opacity, depth, normal,
):  # fmt: skip
    """Renders a RayBatch, or as much of it as each thread's budget allows; returns whether that was all.

    background     (3,) float32 colour to composite over
    packed         see `Packed`
    view_colours   (N + 2, 4) uint16, half floats that are finite: see `compute_view_colours`, from row 1 on; not read where distances of the view are infinity
    view           of all cascades, see `View`
    voxel          size of a voxel of cascade 0, world units
    tile           (rows, columns) of a tile
    budget         of a thread's work, see WORK
    progress       (threads + 1, 3) int64, see `beginning`: the block, the tile in it and the subdivision of that which a thread goes on with; at last the
                   block that no thread has taken
    colour         (H, W, 3) float32
    opacity        (H, W) float32
    depth          (H, W) float32, world units: along the view axis for a camera, along the ray for given rays
    normal         (H, W, 3) float32, or (0, 0, 3) where none is wanted
    """
    # numba removes writes to arrays that come out of a tuple argument: outputs are arguments of their own.
    height, width = opacity.shape
    cascades = len(packed.grids)
    floats, ints = np.zeros((threads, FLOATS), np.float32), np.zeros((threads, INTS), np.int32)
    clear = ENDS + 2 * LANES * cascades
    distances, warped = np.zeros((threads, clear + 3 * cascades)), np.zeros((threads, WARPED))
    looking = np.zeros((threads, 3 * TILE_RAYS), np.float32)
    for worker in numba.prange(threads):
        mine = distances[worker]
        scratch = TileScratch(
            pointer(floats[worker]), pointer(ints[worker]), pointer(mine), pointer(mine[clear:]), pointer(mine[clear + cascades :]),
            pointer(mine[clear + 2 * cascades :]), pointer(warped[worker]), pointer(looking[worker]),
        )  # fmt: skip
        outputs = Outputs(width, pointer(colour), pointer(opacity), pointer(depth), pointer(normal), len(normal) > 0)
        rays = pointers(batch)
        scene = Scene(cascades, packed_pointers(packed, brick), pointer(packed.grids), pointer(packed.places), pointers(view))
        # The index is of another type where numba infers types than where it runs: as it is, the function would be compiled for both.
        _render_blocks(np.int64(worker), threads, budget, progress, height, tile, rays, background, scene, pointer(view_colours[1:]), voxel, scratch, outputs)
    rows, columns = BLOCK * tile[0], BLOCK * tile[1]
    return progress[:threads, 0].min() >= (height + rows - 1) // rows * ((width + columns - 1) // columns)


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def downsample(supersample, fine_colour, fine_opacity, fine_depth, fine_normal, colour, opacity, depth, normal):
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
