"""Normals of packed trees, sixteen at a time (numba)."""

from __future__ import annotations

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.tree.packets.lanes import (
    broadcast16,
    floor16,
    gather16,
    load16,
    mask_of,
    max16,
    min16,
    popcount16,
    select16,
    sqrt16,
    store16,
    to_int16,
)
from efficientnerf.backends.numba.tree.packets.layout import NORMAL_X, NORMAL_Y, NORMAL_Z

_HALF, _ONE, _NONE = np.float32(0.5), np.float32(1), np.float32(0)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _row_density(row, k, fz, gz, grid):  # type: ignore[no-untyped-def]
    """Density between voxels k and k + 1 of rows, numbered over all bricks."""
    if grid.narrow:
        mask = gather16(grid.rows, row)
        begin = mask >> (grid.brick + 2)
    else:
        begin, mask = gather16(grid.rows, row * 2), gather16(grid.rows, row * 2 + 1)
    pair = (mask >> k) & 3
    first = select16(pair == 0, grid.voxels, begin + popcount16(mask & ((1 << k) - 1)))
    low = gather16(grid.density, first) * select16(pair == 2, fz, gz)
    return low + select16(pair == 3, gather16(grid.density, select16(pair == 3, first + 1, first)) * fz, _NONE)


@numba.njit(cache=True, error_model="numpy")
def _densities(u, v, w, lanes, grid):  # type: ignore[no-untyped-def]
    """Densities at points, voxel coordinates; 0 outside of the grid and in empty cells, and where `lanes` are not set."""
    brick, width, per_brick = grid.brick, np.float32(grid.brick), np.float32(1 / grid.brick)
    nx, ny, nz = np.float32(grid.nx), np.float32(grid.ny), np.float32(grid.nz)
    inside = mask_of(lanes) & (u >= _NONE) & (v >= _NONE) & (w >= _NONE) & (u < nx * width) & (v < ny * width) & (w < nz * width)
    a = min16(max16(floor16(u * per_brick), _NONE), nx - _ONE)
    e = min16(max16(floor16(v * per_brick), _NONE), ny - _ONE)
    c = min16(max16(floor16(w * per_brick), _NONE), nz - _ONE)
    owner = gather16(grid.brick_index, select16(inside, (to_int16(a) * grid.ny + to_int16(e)) * grid.nz + to_int16(c), 0))
    inside = inside & (owner >= 0)
    x, y, z = u - a * width + _HALF, v - e * width + _HALF, w - c * width + _HALF
    i, j, k = min16(floor16(x), width), min16(floor16(y), width), min16(floor16(z), width)
    fx, fy, fz = x - i, y - j, z - k
    gx, gy, gz = _ONE - fx, _ONE - fy, _ONE - fz
    side = brick + 2
    row, at = select16(inside, (owner * side + to_int16(i)) * side + to_int16(j), 0), select16(inside, to_int16(k), 0)
    near = gy * _row_density(row, at, fz, gz, grid) + fy * _row_density(row + 1, at, fz, gz, grid)
    far = gy * _row_density(row + side, at, fz, gz, grid) + fy * _row_density(row + side + 1, at, fz, gz, grid)
    return select16(inside, gx * near + fx * far, _NONE)


@numba.njit(cache=True, error_model="numpy")
def add_normals(lanes, x, y, z, grid, floats):  # type: ignore[no-untyped-def]
    """Unit normals at points whose coordinates, voxels, are in `floats` at x, y and z, of the rays whose bits are set: down the density's gradient by central
    differences of one voxel; zero where the density is flat."""
    u, v, w = load16(floats, x), load16(floats, y), load16(floats, z)
    gx = _densities(u - _ONE, v, w, lanes, grid) - _densities(u + _ONE, v, w, lanes, grid)
    gy = _densities(u, v - _ONE, w, lanes, grid) - _densities(u, v + _ONE, w, lanes, grid)
    gz = _densities(u, v, w - _ONE, lanes, grid) - _densities(u, v, w + _ONE, lanes, grid)
    length = sqrt16(gx * gx + gy * gy + gz * gz)
    some = length > _NONE
    length = select16(some, length, broadcast16(_ONE))
    some = some & mask_of(lanes)
    store16(floats, NORMAL_X, select16(some, gx / length, load16(floats, NORMAL_X)))
    store16(floats, NORMAL_Y, select16(some, gy / length, load16(floats, NORMAL_Y)))
    store16(floats, NORMAL_Z, select16(some, gz / length, load16(floats, NORMAL_Z)))
