"""Normals of packed trees, a packet at a time (numba)."""

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.tree.packets.layout import LANES, NORMAL, PLACE
from efficientnerf.backends.numba.vector.maths import floor, mask_of, maximum, minimum, popcount, select, sqrt, to_int32
from efficientnerf.backends.numba.vector.memory import gather, load_three, store_three

_HALF, _ONE, _NONE = np.float32(0.5), np.float32(1), np.float32(0)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _row_density(row, k, fz, gz, grid):
    """Density between voxels k and k + 1 of rows, numbered over all bricks."""
    if grid.narrow:
        mask = gather(grid.rows, row)
        begin = mask >> (grid.brick + 2)
    else:
        begin, mask = gather(grid.rows, row * 2), gather(grid.rows, row * 2 + 1)
    pair = (mask >> k) & 3
    first = select(pair == 0, grid.voxels, begin + popcount(mask & ((1 << k) - 1)))
    low = gather(grid.density, first) * select(pair == 2, fz, gz)
    return low + select(pair == 3, gather(grid.density, select(pair == 3, first + 1, first)) * fz, _NONE)


@numba.njit(cache=True, error_model="numpy")
def _densities(u, v, w, lanes, grid):
    """Densities at points, voxel coordinates; 0 outside of the grid and in empty cells, and where `lanes` are not set."""
    brick, width, per_brick = grid.brick, np.float32(grid.brick), np.float32(1 / grid.brick)
    nx, ny, nz = np.float32(grid.nx), np.float32(grid.ny), np.float32(grid.nz)
    inside = mask_of(lanes, LANES) & (u >= _NONE) & (v >= _NONE) & (w >= _NONE) & (u < nx * width) & (v < ny * width) & (w < nz * width)
    a = minimum(maximum(floor(u * per_brick), _NONE), nx - _ONE)
    e = minimum(maximum(floor(v * per_brick), _NONE), ny - _ONE)
    c = minimum(maximum(floor(w * per_brick), _NONE), nz - _ONE)
    owner = gather(grid.brick_index, select(inside, (to_int32(a) * grid.ny + to_int32(e)) * grid.nz + to_int32(c), 0))
    inside = inside & (owner >= 0)
    x, y, z = u - a * width + _HALF, v - e * width + _HALF, w - c * width + _HALF
    i, j, k = minimum(floor(x), width), minimum(floor(y), width), minimum(floor(z), width)
    fx, fy, fz = x - i, y - j, z - k
    gx, gy, gz = _ONE - fx, _ONE - fy, _ONE - fz
    side = brick + 2
    row, at = select(inside, (owner * side + to_int32(i)) * side + to_int32(j), 0), select(inside, to_int32(k), 0)
    near = gy * _row_density(row, at, fz, gz, grid) + fy * _row_density(row + 1, at, fz, gz, grid)
    far = gy * _row_density(row + side, at, fz, gz, grid) + fy * _row_density(row + side + 1, at, fz, gz, grid)
    return select(inside, gx * near + fx * far, _NONE)


@numba.njit(cache=True, error_model="numpy")
def add_normals(lanes, grid, floats):
    """Unit normals at the places of the rays whose bits are set, voxel coordinates: down the density's gradient by central differences of one voxel; zero
    where the density is flat."""
    u, v, w = load_three(floats, PLACE, LANES)
    gx = _densities(u - _ONE, v, w, lanes, grid) - _densities(u + _ONE, v, w, lanes, grid)
    gy = _densities(u, v - _ONE, w, lanes, grid) - _densities(u, v + _ONE, w, lanes, grid)
    gz = _densities(u, v, w - _ONE, lanes, grid) - _densities(u, v, w + _ONE, lanes, grid)
    length = sqrt(gx * gx + gy * gy + gz * gz)
    some = length > _NONE
    length = select(some, length, _ONE)
    some = some & mask_of(lanes, LANES)
    x, y, z = load_three(floats, NORMAL, LANES)
    store_three(floats, NORMAL, LANES, select(some, gx / length, x), select(some, gy / length, y), select(some, gz / length, z))
