"""Normals of packed trees, a packet at a time (numba)."""

from __future__ import annotations

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.tree.packets.lanes import (
    broadcast32,
    floor_lanes,
    gather_lanes,
    load32,
    mask32,
    max_lanes,
    min_lanes,
    popcount_lanes,
    select_lanes,
    sqrt_lanes,
    store_lanes,
    to_ints,
)
from efficientnerf.backends.numba.tree.packets.layout import NORMAL_X, NORMAL_Y, NORMAL_Z

_HALF, _ONE, _NONE = np.float32(0.5), np.float32(1), np.float32(0)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _row_density(row, k, fz, gz, grid):  # type: ignore[no-untyped-def]
    """Density between voxels k and k + 1 of rows, numbered over all bricks."""
    if grid.narrow:
        mask = gather_lanes(grid.rows, row)
        begin = mask >> (grid.brick + 2)
    else:
        begin, mask = gather_lanes(grid.rows, row * 2), gather_lanes(grid.rows, row * 2 + 1)
    pair = (mask >> k) & 3
    first = select_lanes(pair == 0, grid.voxels, begin + popcount_lanes(mask & ((1 << k) - 1)))
    low = gather_lanes(grid.density, first) * select_lanes(pair == 2, fz, gz)
    return low + select_lanes(pair == 3, gather_lanes(grid.density, select_lanes(pair == 3, first + 1, first)) * fz, _NONE)


@numba.njit(cache=True, error_model="numpy")
def _densities(u, v, w, lanes, grid):  # type: ignore[no-untyped-def]
    """Densities at points, voxel coordinates; 0 outside of the grid and in empty cells, and where `lanes` are not set."""
    brick, width, per_brick = grid.brick, np.float32(grid.brick), np.float32(1 / grid.brick)
    nx, ny, nz = np.float32(grid.nx), np.float32(grid.ny), np.float32(grid.nz)
    inside = mask32(lanes) & (u >= _NONE) & (v >= _NONE) & (w >= _NONE) & (u < nx * width) & (v < ny * width) & (w < nz * width)
    a = min_lanes(max_lanes(floor_lanes(u * per_brick), _NONE), nx - _ONE)
    e = min_lanes(max_lanes(floor_lanes(v * per_brick), _NONE), ny - _ONE)
    c = min_lanes(max_lanes(floor_lanes(w * per_brick), _NONE), nz - _ONE)
    owner = gather_lanes(grid.brick_index, select_lanes(inside, (to_ints(a) * grid.ny + to_ints(e)) * grid.nz + to_ints(c), 0))
    inside = inside & (owner >= 0)
    x, y, z = u - a * width + _HALF, v - e * width + _HALF, w - c * width + _HALF
    i, j, k = min_lanes(floor_lanes(x), width), min_lanes(floor_lanes(y), width), min_lanes(floor_lanes(z), width)
    fx, fy, fz = x - i, y - j, z - k
    gx, gy, gz = _ONE - fx, _ONE - fy, _ONE - fz
    side = brick + 2
    row, at = select_lanes(inside, (owner * side + to_ints(i)) * side + to_ints(j), 0), select_lanes(inside, to_ints(k), 0)
    near = gy * _row_density(row, at, fz, gz, grid) + fy * _row_density(row + 1, at, fz, gz, grid)
    far = gy * _row_density(row + side, at, fz, gz, grid) + fy * _row_density(row + side + 1, at, fz, gz, grid)
    return select_lanes(inside, gx * near + fx * far, _NONE)


@numba.njit(cache=True, error_model="numpy")
def add_normals(lanes, x, y, z, grid, floats):  # type: ignore[no-untyped-def]
    """Unit normals at points whose coordinates, voxels, are in `floats` at x, y and z, of the rays whose bits are set: down the density's gradient by central
    differences of one voxel; zero where the density is flat."""
    u, v, w = load32(floats, x), load32(floats, y), load32(floats, z)
    gx = _densities(u - _ONE, v, w, lanes, grid) - _densities(u + _ONE, v, w, lanes, grid)
    gy = _densities(u, v - _ONE, w, lanes, grid) - _densities(u, v + _ONE, w, lanes, grid)
    gz = _densities(u, v, w - _ONE, lanes, grid) - _densities(u, v, w + _ONE, lanes, grid)
    length = sqrt_lanes(gx * gx + gy * gy + gz * gz)
    some = length > _NONE
    length = select_lanes(some, length, broadcast32(_ONE))
    some = some & mask32(lanes)
    store_lanes(floats, NORMAL_X, select_lanes(some, gx / length, load32(floats, NORMAL_X)))
    store_lanes(floats, NORMAL_Y, select_lanes(some, gy / length, load32(floats, NORMAL_Y)))
    store_lanes(floats, NORMAL_Z, select_lanes(some, gz / length, load32(floats, NORMAL_Z)))
