"""Pixels of a packet of rays (numba): what its rays met, written into the images."""

from typing import Any, NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.tree.packets import layout
from efficientnerf.backends.numba.tree.packets.layout import LANES
from efficientnerf.backends.numba.tree.ray_batch import normal_in_world, world_depth
from efficientnerf.backends.numba.vector.maths import sum_lanes, to_float32, to_float64, to_int32
from efficientnerf.backends.numba.vector.memory import load, load_three, store_rows

INTERPOLATION, LOOKUP = 8, 32  # work of a sample interpolated and of a colour looked up, in samples tested

_NONE, _ONE = np.float32(0), np.float32(1)


class Outputs(NamedTuple):
    """The images that `render_batch` writes, as pointers, and whether normals are wanted."""

    width: int
    colour: Any
    opacity: Any
    depth: Any
    normal: Any
    with_normal: bool


@numba.njit(cache=True, error_model="numpy")
def _unwarp_packet(tile, voxel, rays, scratch, with_normal):
    """Depths and normals of the warped rays of a tile's subdivision as those of the world, world units."""
    lane, floats = 0, scratch.floats
    for row in range(tile.upper, tile.lower):
        begin = (row - tile.top) * (tile.right - tile.left) - tile.left
        for n in range(begin + tile.first, begin + tile.last):
            if floats[layout.DEPTH + lane] < np.inf:
                along, x = floats[layout.DEPTH + lane] * voxel, layout.NORMAL + lane
                y, z = x + LANES, x + 2 * LANES
                floats[layout.DEPTH + lane] = world_depth(n, along, scratch.warped)
                if with_normal:
                    floats[x], floats[y], floats[z] = normal_in_world(n, along, floats[x], floats[y], floats[z], rays.ndc, scratch.warped)
            lane += 1


@numba.njit(cache=True, error_model="numpy")
def _write_rows(tile, background, scale, floats, outputs):
    """Colours, opacities and depths of a packet of four rows of eight pixels, in lanes."""
    first, width, transmittance = tile.upper * outputs.width + tile.first, outputs.width, load(floats, layout.TRANSMITTANCE, LANES)
    red, green, blue = load_three(floats, layout.COLOUR, LANES)
    red, green, blue = red + transmittance * background[0], green + transmittance * background[1], blue + transmittance * background[2]
    store_rows(outputs.colour, 3 * first, 3 * width, (red, green, blue), 8)
    store_rows(outputs.opacity, first, width, (_ONE - transmittance,), 8)
    store_rows(outputs.depth, first, width, (to_float32(to_float64(load(floats, layout.DEPTH, LANES)) * scale),), 8)


@numba.njit(cache=True, error_model="numpy")
def _write_pixels(tile, background, scale, floats, outputs):
    """All that is wanted of a packet of any shape, pixel by pixel."""
    lane = 0
    for row in range(tile.upper, tile.lower):
        for pixel in range(row * outputs.width + tile.first, row * outputs.width + tile.last):
            for c in range(3):
                outputs.colour[3 * pixel + c] = floats[layout.COLOUR + LANES * c + lane] + floats[layout.TRANSMITTANCE + lane] * background[c]
                if outputs.with_normal:
                    outputs.normal[3 * pixel + c] = floats[layout.NORMAL + LANES * c + lane]
            outputs.opacity[pixel], outputs.depth[pixel] = _ONE - floats[layout.TRANSMITTANCE + lane], floats[layout.DEPTH + lane] * scale
            lane += 1


@numba.njit(cache=True, error_model="numpy")
def write_clear(top, low, left, right, background, outputs):
    """Writes pixels whose rays met nothing; returns the work that they were."""
    for row in range(top, low):
        for pixel in range(row * outputs.width + left, row * outputs.width + right):
            for c in range(3):
                outputs.colour[3 * pixel + c] = background[c]
            outputs.opacity[pixel], outputs.depth[pixel] = _NONE, np.float32(np.inf)
        for n in range(3 * (row * outputs.width + left), 3 * (row * outputs.width + right) if outputs.with_normal else 0):
            outputs.normal[n] = _NONE
    return (low - top) * (right - left)


@numba.njit(cache=True, error_model="numpy")
def write_packet(tile, background, voxel, rays, scratch, outputs):
    """Writes the pixels of a tile's subdivision; returns the work that they were."""
    floats, count = scratch.floats, (tile.lower - tile.upper) * (tile.last - tile.first)
    if rays.warped:
        _unwarp_packet(tile, voxel, rays, scratch, outputs.with_normal)
    scale = 1.0 if rays.warped else voxel
    if count == LANES and tile.last - tile.first == 8 and not outputs.with_normal:
        _write_rows(tile, background, scale, floats, outputs)
    else:
        _write_pixels(tile, background, scale, floats, outputs)
    visited, tested, interpolated = load_three(floats, layout.VISITED, LANES)
    work = to_int32(visited + tested) + to_int32(interpolated) * INTERPOLATION
    return count + sum_lanes(work + to_int32(load(floats, layout.LOOKUPS, LANES)) * LOOKUP)
