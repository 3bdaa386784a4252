"""Ray marching over a tree's own arrays (numba), specialised by lookup; rendering of nearest-lookup trees and refinement share it.

Samples lie as FORMAT.md says, section 6. Interpolated trees are rendered from their packed form: `efficientnerf.backends.numba.tree.march`.

N stored voxels, S samples of a ray.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.simd import pointer
from efficientnerf.backends.numba.tree.march import STEP


class TreeGrid(NamedTuple):
    """Structure of a tree; see `NerfTree`.

    step_length  of STEP voxels, units of the frame
    nearest      whether the lookup is nearest, else trilinear
    """

    brick: int
    brick_index: np.ndarray
    voxel_index: np.ndarray
    leap: np.ndarray
    step_length: float
    nearest: bool = False

    @property
    def max_samples(self) -> int:
        """Samples on a ray, at most."""
        return most_samples(*(side * self.brick for side in self.brick_index.shape))


class WalkPointers(NamedTuple):
    """A TreeGrid and densities with arrays as pointers; nx, ny, nz coarse cells, `cube` voxels in a brick."""

    brick: int
    cube: int
    nx: int
    ny: int
    nz: int
    brick_index: Any
    voxel_index: Any
    leap: Any
    density: Any
    step_length: float
    nearest: bool


class SampleBuffer(NamedTuple):
    """Samples of a ray that have density, arrays as pointers.

    capacity       S
    index          (S, 8) int32 stored voxels of the corners, z fastest, -1 where none is stored; nearest lookup writes the first alone, the others must be -1
    fraction       (S, 3) place between the corners, 0 to 1, in the densities' type; nearest lookup writes none, they must be 0
    alpha          (S,) float64
    transmittance  (S,) float64 at which light arrives
    distance       (S,) float64 from the origin, voxels
    """

    capacity: int
    index: Any
    fraction: Any
    alpha: Any
    transmittance: Any
    distance: Any


@numba.njit(cache=True, error_model="numpy")
def most_samples(nx, ny, nz):  # type: ignore[no-untyped-def]
    """Samples on a ray through a grid of so many voxels, at most. Distances far beyond the grid are rounded to more than that."""
    return int(np.ceil(np.sqrt(nx * nx + ny * ny + nz * nz) / STEP)) + 2


@numba.njit(cache=True, inline="always", error_model="numpy")
def walk_pointers(grid, density):  # type: ignore[no-untyped-def]
    """See `WalkPointers`."""
    nx, ny, nz = grid.brick_index.shape
    return WalkPointers(
        grid.brick, grid.voxel_index.shape[1], nx, ny, nz, pointer(grid.brick_index), pointer(grid.voxel_index), pointer(grid.leap), pointer(density),
        grid.step_length, grid.nearest,
    )  # fmt: skip


@numba.njit(cache=True, inline="always", error_model="numpy")
def stored_voxel(i, j, k, tree):  # type: ignore[no-untyped-def]
    """Index of the stored voxel (i, j, k), or -1."""
    if i < 0 or j < 0 or k < 0:
        return np.int32(-1)
    brick = tree.brick
    a, b, c = i // brick, j // brick, k // brick
    if a >= tree.nx or b >= tree.ny or c >= tree.nz:
        return np.int32(-1)
    owner = np.int64(tree.brick_index[(a * tree.ny + b) * tree.nz + c])
    if owner < 0:
        return np.int32(-1)
    return np.int32(tree.voxel_index[owner * tree.cube + ((i - a * brick) * brick + (j - b * brick)) * brick + (k - c * brick)])


@numba.njit(cache=True, error_model="numpy")
def corner_voxels(i, j, k, tree, index, at):  # type: ignore[no-untyped-def]
    """The stored voxels (i or i + 1, j or j + 1, k or k + 1), z fastest, into index[at : at + 8]; -1 where there is none."""
    brick = tree.brick
    li, lj, lk = i % brick, j % brick, k % brick
    if i >= 0 and j >= 0 and k >= 0 and li < brick - 1 and lj < brick - 1 and lk < brick - 1:
        # All eight in one brick: one lookup in the coarse level.
        a, b, c = i // brick, j // brick, k // brick
        owner = np.int64(-1)
        if a < tree.nx and b < tree.ny and c < tree.nz:
            owner = np.int64(tree.brick_index[(a * tree.ny + b) * tree.nz + c])
        first = owner * tree.cube + (li * brick + lj) * brick + lk
        for n in range(8):
            index[at + n] = tree.voxel_index[first + ((n >> 2) * brick + ((n >> 1) & 1)) * brick + (n & 1)] if owner >= 0 else -1
        return
    for n in range(8):
        index[at + n] = stored_voxel(i + (n >> 2), j + ((n >> 1) & 1), k + (n & 1), tree)


@numba.njit(cache=True, inline="always", error_model="numpy")
def corner_weight(n, fx, fy, fz):  # type: ignore[no-untyped-def]
    """Trilinear weight of corner n."""
    return (fx if n & 4 else 1 - fx) * (fy if n & 2 else 1 - fy) * (fz if n & 1 else 1 - fz)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _lookup_nearest(u, v, w, tree, buffer, count):  # type: ignore[no-untyped-def]
    """Density of the voxel that holds a point; writes the first corner of sample `count`."""
    voxel = stored_voxel(int(u), int(v), int(w), tree)
    buffer.index[8 * count] = voxel
    return np.float64(tree.density[voxel]) if voxel >= 0 else 0.0


@numba.njit(cache=True, inline="always", error_model="numpy")
def _lookup_trilinear(u, v, w, tree, buffer, count):  # type: ignore[no-untyped-def]
    """Density interpolated between the eight voxels around a point; writes corners and fractions of sample `count`."""
    at = 8 * count
    x, y, z = np.floor(u - 0.5), np.floor(v - 0.5), np.floor(w - 0.5)
    fx, fy, fz = u - 0.5 - x, v - 0.5 - y, w - 0.5 - z
    corner_voxels(int(x), int(y), int(z), tree, buffer.index, at)
    buffer.fraction[3 * count], buffer.fraction[3 * count + 1], buffer.fraction[3 * count + 2] = fx, fy, fz
    sigma = 0.0
    for n in range(8):
        if buffer.index[at + n] >= 0:
            sigma += corner_weight(n, fx, fy, fz) * tree.density[buffer.index[at + n]]
    return sigma


@numba.njit(cache=True, error_model="numpy")
def walk(origin, direction, tree, stop, buffer):  # type: ignore[no-untyped-def]
    """Writes the samples of a ray, voxel coordinates, that have density, as many as the buffer holds; returns their number and the transmittance behind them.

    stop  transmittance below which the ray ends
    """
    count, transmittance, _ = walk_on(origin, direction, tree, stop, buffer, 0, 1.0)
    return count, transmittance


@numba.njit(cache=True, error_model="numpy")
def walk_on(origin, direction, tree, stop, buffer, k, transmittance):  # type: ignore[no-untyped-def]
    """`walk` from sample k on, where so much light arrives; returns the number of samples, the transmittance behind them, and the k to go on with, or -1."""
    brick = tree.brick
    nx, ny, nz = tree.nx * brick, tree.ny * brick, tree.nz * brick
    ox, oy, oz = origin[0], origin[1], origin[2]
    dx, dy, dz = direction[0], direction[1], direction[2]
    ix = 1 / dx if dx != 0 else 1e30
    iy = 1 / dy if dy != 0 else 1e30
    iz = 1 / dz if dz != 0 else 1e30
    t0 = max(min(-ox * ix, (nx - ox) * ix), min(-oy * iy, (ny - oy) * iy), min(-oz * iz, (nz - oz) * iz), 0.0)
    t1 = min(max(-ox * ix, (nx - ox) * ix), max(-oy * iy, (ny - oy) * iy), max(-oz * iz, (nz - oz) * iz))
    if not t1 > t0 or (dx == 0 and (ox < 0 or ox > nx)) or (dy == 0 and (oy < 0 or oy > ny)) or (dz == 0 and (oz < 0 or oz > nz)):
        return 0, transmittance, -1
    count = 0
    last = int(np.floor(min((t1 - t0) / STEP, most_samples(nx, ny, nz)))) + 1
    while k < last:
        if count == buffer.capacity:
            return count, transmittance, k
        t = t0 + (k + 0.5) * STEP
        if t >= t1:
            break
        u, v, w = ox + t * dx, oy + t * dy, oz + t * dz
        if not (0 <= u < nx and 0 <= v < ny and 0 <= w < nz):  # by rounding, at a face
            k += 1
            continue
        a, b, c = int(u) // brick, int(v) // brick, int(w) // brick
        leap = int(tree.leap[(a * tree.ny + b) * tree.nz + c])
        if leap > 0:
            fx = ((a + leap) * brick - ox) * ix if dx > 0 else ((a - leap + 1) * brick - ox) * ix
            fy = ((b + leap) * brick - oy) * iy if dy > 0 else ((b - leap + 1) * brick - oy) * iy
            fz = ((c + leap) * brick - oz) * iz if dz > 0 else ((c - leap + 1) * brick - oz) * iz
            if dx == 0:
                fx = 1e30
            if dy == 0:
                fy = 1e30
            if dz == 0:
                fz = 1e30
            k = max(k + 1, int(np.ceil((min(fx, fy, fz) - t0) / STEP - 0.5)))
            continue
        k += 1
        sigma = _lookup_nearest(u, v, w, tree, buffer, count) if tree.nearest else _lookup_trilinear(u, v, w, tree, buffer, count)
        if sigma > 0:
            buffer.alpha[count], buffer.transmittance[count], buffer.distance[count] = 1 - np.exp(-sigma * tree.step_length), transmittance, t
            transmittance *= 1 - buffer.alpha[count]
            count += 1
            if transmittance < stop:
                break
    return count, transmittance, -1
