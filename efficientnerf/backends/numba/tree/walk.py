"""Ray marching over a tree's own arrays (numba), specialised by lookup; rendering of nearest-lookup trees and refinement share it.

Samples lie as FORMAT.md says, section 6; in nested trees as `efficientnerf.asset.rendering.ray_parts` says. Interpolated trees are rendered from their packed
form: `efficientnerf.backends.numba.tree.packets`.

Coordinates of rays are in voxels of the tree's own grid, cascade 0. N stored voxels, S samples of a ray, L cascades, C coarse cells of all outer cascades.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.simd import pointer
from efficientnerf.backends.numba.tree.leaps import leaps


class TreeGrid(NamedTuple):
    """Structure of a tree; see `NerfTree`.

    step               distance between samples, voxels
    step_length        the same in cascade 0, units of the frame
    nearest            whether the lookup is nearest, else trilinear
    outer_shape        (L - 1, 3) int64 coarse cells of the cascades after the first
    outer_first        (L - 1,) int64 where each one's cells begin in the next two
    outer_brick_index  (C,) int32, outer_leap (C,) uint8
    outer_corner       (L - 1, 3) float64 corner, voxels of cascade 0
    outer_scale        (L - 1,) float64 side of a voxel, voxels of cascade 0
    """

    brick: int
    brick_index: np.ndarray
    voxel_index: np.ndarray
    leap: np.ndarray
    step: float
    step_length: float
    nearest: bool = False
    outer_shape: np.ndarray = np.zeros((0, 3), np.int64)
    outer_first: np.ndarray = np.zeros(0, np.int64)
    outer_brick_index: np.ndarray = np.zeros(0, np.int32)
    outer_leap: np.ndarray = np.zeros(0, np.uint8)
    outer_corner: np.ndarray = np.zeros((0, 3))
    outer_scale: np.ndarray = np.zeros(0)

    @property
    def max_samples(self) -> int:
        """Samples on a ray, at most."""
        sizes = [self.brick_index.shape, *self.outer_shape.tolist()]
        # Each outer cascade may begin its samples anew behind the one that is cut out of it.
        return sum(most_samples(*(side * self.brick for side in size), self.step) for size in sizes) + 2 * len(self.outer_shape)


class WalkPointers(NamedTuple):
    """A TreeGrid and densities with arrays as pointers; nx, ny, nz coarse cells, `cube` voxels in a brick.

    cascades  L; 1 in the grid of a single cascade that `outer_grid` makes
    first     where the grid's cells begin in brick_index and leap
    """

    brick: int
    cube: int
    nx: int
    ny: int
    nz: int
    brick_index: Any
    voxel_index: Any
    leap: Any
    density: Any
    step: float
    step_length: float
    nearest: bool
    cascades: int
    first: int
    outer_shape: Any
    outer_first: Any
    outer_brick_index: Any
    outer_leap: Any
    outer_corner: Any
    outer_scale: Any


class SampleBuffer(NamedTuple):
    """Samples of a ray that have density, arrays as pointers.

    capacity       S
    index          (S, 8) int32 stored voxels of the corners, z fastest, -1 where none is stored; nearest lookup writes the first alone, the others must be -1
    fraction       (S, 3) place between the corners, 0 to 1, in the densities' type; nearest lookup writes none, they must be 0
    alpha          (S,) float64
    transmittance  (S,) float64 at which light arrives
    distance       (S,) float64 from the origin, voxels
    length         (S,) float64 of the step, units of the frame
    """

    capacity: int
    index: Any
    fraction: Any
    alpha: Any
    transmittance: Any
    distance: Any
    length: Any


def tree_grid(tree: NerfTree) -> TreeGrid:
    """The structure of a tree, with its cascades."""
    outer = _outer_grids(tree) if tree.outer else ()
    step = float(tree.step_size)
    return TreeGrid(tree.brick, tree.brick_index, tree.voxel_index, tree.leap, step, float(step * tree.voxel), tree.lookup == "nearest", *outer)


def _outer_grids(tree: NerfTree) -> tuple[np.ndarray, ...]:
    """The fields of a TreeGrid that are of the outer cascades, in order, kept with the tree."""
    if "outer_grids" not in tree.derived:
        cells = [cascade.brick_index.size for cascade in tree.outer]
        tree.derived["outer_grids"] = (
            np.asarray([cascade.shape for cascade in tree.outer], np.int64),
            np.cumsum([0, *cells[:-1]]).astype(np.int64),
            np.concatenate([cascade.brick_index.reshape(-1) for cascade in tree.outer]).astype(np.int32),
            np.concatenate([leaps(cascade.brick_index >= 0).reshape(-1) for cascade in tree.outer]),
            np.stack([(cascade.bounds_min - tree.bounds_min) / tree.voxel for cascade in tree.outer]).astype(np.float64),
            np.asarray([cascade.voxel / tree.voxel for cascade in tree.outer], np.float64),
        )
    return tree.derived["outer_grids"]


@numba.njit(cache=True, error_model="numpy")
def most_samples(nx, ny, nz, step):  # type: ignore[no-untyped-def]
    """Samples on a ray through a grid of so many voxels, `step` apart, at most. Distances far beyond the grid are rounded to more than that."""
    return int(np.ceil(np.sqrt(nx * nx + ny * ny + nz * nz) / step)) + 2


@numba.njit(cache=True, inline="always", error_model="numpy")
def walk_pointers(grid, density):  # type: ignore[no-untyped-def]
    """See `WalkPointers`."""
    nx, ny, nz = grid.brick_index.shape
    return WalkPointers(
        grid.brick, grid.voxel_index.shape[1], nx, ny, nz, pointer(grid.brick_index), pointer(grid.voxel_index), pointer(grid.leap), pointer(density),
        grid.step, grid.step_length, grid.nearest, 1 + len(grid.outer_first), 0, pointer(grid.outer_shape), pointer(grid.outer_first),
        pointer(grid.outer_brick_index), pointer(grid.outer_leap), pointer(grid.outer_corner), pointer(grid.outer_scale),
    )  # fmt: skip


@numba.njit(cache=True, inline="always", error_model="numpy")
def outer_grid(tree, n):  # type: ignore[no-untyped-def]
    """Cascade n, from 1 on, as a grid of its own: rays then are in its voxels."""
    m = n - 1
    return WalkPointers(
        tree.brick, tree.cube, tree.outer_shape[3 * m], tree.outer_shape[3 * m + 1], tree.outer_shape[3 * m + 2], tree.outer_brick_index, tree.voxel_index,
        tree.outer_leap, tree.density, tree.step, tree.step_length * tree.outer_scale[m], tree.nearest, 1, tree.outer_first[m], tree.outer_shape,
        tree.outer_first, tree.outer_brick_index, tree.outer_leap, tree.outer_corner, tree.outer_scale,
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
    owner = np.int64(tree.brick_index[tree.first + (a * tree.ny + b) * tree.nz + c])
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
            owner = np.int64(tree.brick_index[tree.first + (a * tree.ny + b) * tree.nz + c])
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


@numba.njit(cache=True, inline="always", error_model="numpy")
def box_distances(ox, oy, oz, dx, dy, dz, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Distances at which a ray enters, 0 at least, and leaves the box of a grid of so many voxels; the second is not greater where it misses it."""
    ix = 1 / dx if dx != 0 else 1e30
    iy = 1 / dy if dy != 0 else 1e30
    iz = 1 / dz if dz != 0 else 1e30
    t0 = max(min(-ox * ix, (nx - ox) * ix), min(-oy * iy, (ny - oy) * iy), min(-oz * iz, (nz - oz) * iz), 0.0)
    t1 = min(max(-ox * ix, (nx - ox) * ix), max(-oy * iy, (ny - oy) * iy), max(-oz * iz, (nz - oz) * iz))
    if not t1 > t0 or (dx == 0 and (ox < 0 or ox > nx)) or (dy == 0 and (oy < 0 or oy > ny)) or (dz == 0 and (oz < 0 or oz > nz)):
        return t0, t0
    return t0, t1


@numba.njit(cache=True, inline="always", error_model="numpy")
def _walk_part(ox, oy, oz, dx, dy, dz, t0, t1, tree, scale, stop, buffer, count, k, transmittance):  # type: ignore[no-untyped-def]
    """Samples of a ray between two distances in one grid, coordinates and distances in its voxels, from sample k on.

    scale    side of a voxel of the grid, voxels of cascade 0
    returns  number of samples in the buffer, `count` of which were there before; the transmittance behind them; and the k to go on with, or -1
    """
    brick = tree.brick
    nx, ny, nz = tree.nx * brick, tree.ny * brick, tree.nz * brick
    ix = 1 / dx if dx != 0 else 1e30
    iy = 1 / dy if dy != 0 else 1e30
    iz = 1 / dz if dz != 0 else 1e30
    last = int(np.floor(min((t1 - t0) / tree.step, most_samples(nx, ny, nz, tree.step)))) + 1
    while k < last:
        if count == buffer.capacity:
            return count, transmittance, k
        t = t0 + (k + 0.5) * tree.step
        if t >= t1:
            break
        u, v, w = ox + t * dx, oy + t * dy, oz + t * dz
        if not (0 <= u < nx and 0 <= v < ny and 0 <= w < nz):  # by rounding, at a face
            k += 1
            continue
        a, b, c = int(u) // brick, int(v) // brick, int(w) // brick
        leap = int(tree.leap[tree.first + (a * tree.ny + b) * tree.nz + c])
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
            k = max(k + 1, int(np.ceil((min(fx, fy, fz) - t0) / tree.step - 0.5)))
            continue
        k += 1
        sigma = _lookup_nearest(u, v, w, tree, buffer, count) if tree.nearest else _lookup_trilinear(u, v, w, tree, buffer, count)
        if sigma > 0:
            buffer.alpha[count], buffer.transmittance[count] = 1 - np.exp(-sigma * tree.step_length), transmittance
            buffer.distance[count], buffer.length[count] = t * scale, tree.step_length
            transmittance *= 1 - buffer.alpha[count]
            count += 1
            if transmittance < stop:
                break
    return count, transmittance, -1


@numba.njit(cache=True, error_model="numpy")
def walk_on(origin, direction, tree, stop, buffer, k, transmittance):  # type: ignore[no-untyped-def]
    """`walk` from sample k on, where so much light arrives; returns the number of samples, the transmittance behind them, and the k to go on with, or -1."""
    if tree.cascades > 1:
        return _walk_cascades(origin, direction, tree, stop, buffer, k, transmittance)
    ox, oy, oz, dx, dy, dz = origin[0], origin[1], origin[2], direction[0], direction[1], direction[2]
    t0, t1 = box_distances(ox, oy, oz, dx, dy, dz, tree.nx * tree.brick, tree.ny * tree.brick, tree.nz * tree.brick)
    if not t1 > t0:
        return 0, transmittance, -1
    return _walk_part(ox, oy, oz, dx, dy, dz, t0, t1, tree, 1.0, stop, buffer, 0, k, transmittance)


@numba.njit(cache=True, error_model="numpy")
def _cascade_meeting(origin, direction, tree, n):  # type: ignore[no-untyped-def]
    """Distances at which a ray enters and leaves the box of cascade n, voxels of cascade 0, as `box_distances`."""
    dx, dy, dz, brick = direction[0], direction[1], direction[2], tree.brick
    if n == 0:
        return box_distances(origin[0], origin[1], origin[2], dx, dy, dz, tree.nx * brick, tree.ny * brick, tree.nz * brick)
    m = n - 1
    scale = tree.outer_scale[m]
    x, y, z = origin[0] - tree.outer_corner[3 * m], origin[1] - tree.outer_corner[3 * m + 1], origin[2] - tree.outer_corner[3 * m + 2]
    side = scale * brick
    return box_distances(x, y, z, dx, dy, dz, tree.outer_shape[3 * m] * side, tree.outer_shape[3 * m + 1] * side, tree.outer_shape[3 * m + 2] * side)


PART = 2**32  # samples of a part of a ray, at most: `walk_on` of a nested tree goes on with PART times the part plus the sample in it


@numba.njit(cache=True, error_model="numpy")
def _walk_cascades(origin, direction, tree, stop, buffer, k, transmittance):  # type: ignore[no-untyped-def]
    """`walk_on` in a nested tree: part p of a ray lies in cascade |L - 1 - p|, before or behind the box that is cut out of that."""
    count, outermost = 0, tree.cascades - 1
    part, k = k // PART, k % PART
    while part <= 2 * outermost:
        n = abs(outermost - part)
        t0, t1 = _cascade_meeting(origin, direction, tree, n)
        if n == outermost and not t1 > t0:
            return count, transmittance, -1
        if n > 0:
            enter, leave = _cascade_meeting(origin, direction, tree, n - 1)
            if leave > enter and part < outermost:
                t1 = enter
            elif part > outermost:
                t0 = leave if leave > enter else t1
        if t1 > t0:
            ox, oy, oz, dx, dy, dz = origin[0], origin[1], origin[2], direction[0], direction[1], direction[2]
            grid, scale = tree, 1.0
            if n > 0:
                grid, scale = outer_grid(tree, n), tree.outer_scale[n - 1]
                ox, oy, oz = ox - tree.outer_corner[3 * n - 3], oy - tree.outer_corner[3 * n - 2], oz - tree.outer_corner[3 * n - 1]
            count, transmittance, k = _walk_part(
                ox / scale, oy / scale, oz / scale, dx, dy, dz, t0 / scale, t1 / scale, grid, scale, stop, buffer, count, k, transmittance
            )
            if k >= 0:
                return count, transmittance, part * PART + k
            if transmittance < stop:
                break
        part, k = part + 1, 0
    return count, transmittance, -1
