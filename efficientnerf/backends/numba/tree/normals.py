"""Normals of packed trees at points inside blocks (numba)."""

from __future__ import annotations

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.tree.blocks import fill_block
from efficientnerf.backends.numba.tree.march import has_density, trilinear_density

_HALF, _ONE = np.float32(0.5), np.float32(1)


@numba.njit(cache=True, error_model="numpy")
def _density(u, v, w, grid, view, pool):  # type: ignore[no-untyped-def]
    """Scaled density at a point, voxel coordinates, float32; 0 outside of the grid and in an empty cell."""
    brick = grid.brick
    if not (0 <= u < grid.nx * brick and 0 <= v < grid.ny * brick and 0 <= w < grid.nz * brick):
        return np.float32(0)
    per_brick = np.float32(1 / brick)
    a, e, c = min(int(u * per_brick), grid.nx - 1), min(int(v * per_brick), grid.ny - 1), min(int(w * per_brick), grid.nz - 1)
    owner = np.int64(grid.brick_index[(a * grid.ny + e) * grid.nz + c])
    if owner < 0:
        return np.float32(0)
    x, y, z = u - np.float32(a * brick) + _HALF, v - np.float32(e * brick) + _HALF, w - np.float32(c * brick) + _HALF
    i, j, k = int(x), int(y), int(z)
    side = brick + 2
    voxel = (i * side + j) * side + k
    if not has_density(owner, voxel, grid):
        return np.float32(0)
    slot = np.int64(pool.slot_of[owner])
    if slot < 0:
        slot = fill_block(owner, grid, view, pool)
    at = slot * pool.block_size + 4 * voxel
    return trilinear_density(pool.values, at, 4 * side, 4 * side * side, x - np.float32(i), y - np.float32(j), z - np.float32(k))


@numba.njit(cache=True, inline="always", error_model="numpy")
def _difference(x, stride, at, row, layer, fx, fy, fz, brick, pool):  # type: ignore[no-untyped-def]
    """Central difference of the density over two voxels along the axis of a stride; NaN where a neighbour lies in another cell.

    x               coordinate of the point in its block along that axis, voxels
    at, fx, fy, fz  offset of the lowest of its eight voxels, and its fractions between them
    """
    difference = np.float32(np.nan)
    if _ONE + _HALF <= x < np.float32(brick) - _HALF:
        difference = trilinear_density(pool.values, at + stride, row, layer, fx, fy, fz) - trilinear_density(pool.values, at - stride, row, layer, fx, fy, fz)
    return difference


@numba.njit(cache=True, error_model="numpy")
def normal_into(u, v, w, grid, view, pool, out):  # type: ignore[no-untyped-def]
    """Unit normal, down the density's gradient by central differences of one voxel, into `out`; zero where the density is flat."""
    brick = grid.brick
    side, per_brick = brick + 2, np.float32(1 / brick)
    gx = gy = gz = np.float32(np.nan)
    a, e, c = min(max(int(u * per_brick), 0), grid.nx - 1), min(max(int(v * per_brick), 0), grid.ny - 1), min(max(int(w * per_brick), 0), grid.nz - 1)
    cell = (a * grid.ny + e) * grid.nz + c
    if grid.leap[cell] == 0:
        owner = np.int64(grid.brick_index[cell])
        slot = np.int64(pool.slot_of[owner])
        if slot < 0:
            slot = fill_block(owner, grid, view, pool)
        x, y, z = u - np.float32(a * brick) + _HALF, v - np.float32(e * brick) + _HALF, w - np.float32(c * brick) + _HALF
        i, j, k = min(max(int(x), 0), brick), min(max(int(y), 0), brick), min(max(int(z), 0), brick)
        fx, fy, fz = x - np.float32(i), y - np.float32(j), z - np.float32(k)
        row, layer = 4 * side, 4 * side * side
        at = slot * pool.block_size + i * layer + j * row + 4 * k
        gx = _difference(x, layer, at, row, layer, fx, fy, fz, brick, pool)
        gy = _difference(y, row, at, row, layer, fx, fy, fz, brick, pool)
        gz = _difference(z, 4, at, row, layer, fx, fy, fz, brick, pool)
    # Across the faces of the cell lies another block, or an empty cell, whatever this block holds there.
    if gx != gx:
        gx = _density(u + _ONE, v, w, grid, view, pool) - _density(u - _ONE, v, w, grid, view, pool)
    if gy != gy:
        gy = _density(u, v + _ONE, w, grid, view, pool) - _density(u, v - _ONE, w, grid, view, pool)
    if gz != gz:
        gz = _density(u, v, w + _ONE, grid, view, pool) - _density(u, v, w - _ONE, grid, view, pool)
    length = np.sqrt(gx * gx + gy * gy + gz * gz)
    if length > 0:
        out[0], out[1], out[2] = -gx / length, -gy / length, -gz / length
    else:
        out[0] = out[1] = out[2] = np.float32(0)
