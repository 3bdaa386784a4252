"""Rays marched through a NerfTree by the CUDA kernels (Triton): the one loop over samples, and what a sample finds in the tree.

Rays are sampled as `efficientnerf/asset/FORMAT.md` says, sections 6 and 9: nothing in empty coarse cells, and a ray in such a cell
skips to the end of the empty cube around it. Coordinates are in voxels. `grid` and `index`: see `efficientnerf.backends.triton.tree.DeviceTree`.
Offsets that grow with the tree have 64 bits: 1536^3 cells are more than 2^31.

In a nested tree a ray passes its parts in the cascades one after the other, as `efficientnerf.asset.rendering.ray_parts` says; coordinates are in voxels of
the cascade that is marched, those that callers give and get in voxels of cascade 0.

NEAREST: a sample takes the value of the voxel that holds it, which stands for corner 0 with weight 1; there are no other corners.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import triton
import triton.language as tl

from efficientnerf.backends.layout import EARLY_STOP
from efficientnerf.backends.triton.vectors import Vec3, along, sigmoid

STOP = tl.constexpr(EARLY_STOP)  # transmittance at which a ray ends


class Grid(NamedTuple):
    """owner  pointer to (X, Y, Z) int32: the brick of a coarse cell, or the negative of the cells that a ray may skip
    shape     coarse cells along each axis"""

    owner: Any
    shape: Any


class Cascades(NamedTuple):
    """The grids of a tree, L cascades."""

    owner: Any  # the coarse cells of all grids, as in Grid
    shapes: Any  # (L, 3) int32 coarse cells of each
    first: Any  # (L,) int64 where each one's cells begin
    place: Any  # (L, 4) float32 corner, and side of a voxel, voxels of cascade 0
    shape: Any  # of cascade 0, as in Grid
    step: Any  # between samples, voxels


class Rays(NamedTuple):
    """Of a batch, float32 (R, 3), contiguous: origins and directions in voxel coordinates of cascade 0, and directions in the world, `views`."""

    origins: Any
    directions: Any
    views: Any


class Voxels(NamedTuple):
    """Where voxels lie, their densities and harmonics, and the side of cascade 0's in the frame."""

    index: Any
    density: Any
    sh: Any
    voxel: Any


class Scene(NamedTuple):
    """Voxels; basis (R, C) harmonics of the columns of a row of coefficients; column (C,)."""

    voxels: Any
    basis: Any
    column: Any


class Ray(NamedTuple):
    """origin, direction (unit), inverse (1 / direction) Vec3; enter, leave: distances between which it is in the grid, enter >= 0."""

    origin: Any
    direction: Any
    inverse: Any
    enter: Any
    leave: Any
    unit: Any  # side of a voxel of the grid, voxels of cascade 0
    step: Any  # between samples, voxels


class Sample(NamedTuple):
    """A sample on a ray."""

    distance: Any  # along the ray
    unit: Any  # of distances and steps, voxels of cascade 0
    step: Any  # to the next sample, voxels
    inside: Any  # whether it lies in a brick
    corner: Any  # place of its lowest corner in the arrays of bricks with border
    fraction: Any  # Vec3 from there to the next corner, 0 to 1


@triton.jit
def _slab(o, d, high):
    """Along one axis: 1 / d, and the distances at which a ray enters and leaves 0 to `high`; never, where it is parallel and outside."""
    parallel = d == 0
    inverse = tl.where(parallel, 1e30, 1 / tl.where(parallel, 1.0, d))
    one, other = -o * inverse, (high - o) * inverse
    missed = parallel & ((o < 0) | (o > high))
    return inverse, tl.where(missed, 1e30, tl.minimum(one, other)), tl.where(missed, -1e30, tl.maximum(one, other))


@triton.jit
def ray_in_grid(grid, origin, direction, unit, step, BRICK: tl.constexpr):
    """A Ray from its origin and direction, voxel coordinates."""
    ix, ax, bx = _slab(origin.x, direction.x, grid.shape.x * BRICK)
    iy, ay, by = _slab(origin.y, direction.y, grid.shape.y * BRICK)
    iz, az, bz = _slab(origin.z, direction.z, grid.shape.z * BRICK)
    enter = tl.maximum(tl.maximum(ax, ay), tl.maximum(az, 0.0))
    # No ray is longer in the grid than its sides together, but where distances far beyond it are rounded: so its samples are bounded, too.
    longest = (grid.shape.x + grid.shape.y + grid.shape.z) * BRICK + 2.0
    return Ray(origin, direction, Vec3(ix, iy, iz), enter, tl.minimum(tl.minimum(tl.minimum(bx, by), bz), enter + longest), unit, step)


@triton.jit
def _cell_of(u, cells, BRICK: tl.constexpr):
    """Coarse cell of a voxel coordinate, clamped to the grid."""
    return (tl.minimum(tl.maximum(u, 0.0), cells * BRICK - 0.5) / BRICK).to(tl.int32)


@triton.jit
def _cells_of(grid, point, BRICK: tl.constexpr):
    return Vec3(_cell_of(point.x, grid.shape.x, BRICK), _cell_of(point.y, grid.shape.y, BRICK), _cell_of(point.z, grid.shape.z, BRICK))


@triton.jit
def _owner(grid, cell, live):
    return tl.load(grid.owner + (cell.x.to(tl.int64) * grid.shape.y + cell.y) * grid.shape.z + cell.z, live, other=-1)


@triton.jit
def _cube_exit(o, d, inverse, cell, radius, BRICK: tl.constexpr):
    """Distance at which a ray leaves the empty cube of `radius` cells around its own, along one axis."""
    face = tl.where(d > 0, cell + radius, cell - radius + 1) * BRICK
    return tl.where(d == 0, 1e30, (face - o) * inverse)


@triton.jit
def _first_corner(u, cell, BRICK: tl.constexpr, NEAREST: tl.constexpr):
    """Along one axis: the lower corner of a point in the brick of `cell` with its border, and the fraction from there to the next corner."""
    if NEAREST:
        i = tl.minimum(tl.maximum(tl.floor(u) - cell * BRICK, 0.0), BRICK - 1.0)
        fraction = tl.zeros_like(u)
    else:
        x = u - cell * BRICK - 0.5
        i = tl.minimum(tl.maximum(tl.floor(x), -1.0), BRICK - 1.0)
        fraction = x - i
    return i.to(tl.int32) + 1, fraction


@triton.jit
def _place_in_brick(point, cell, brick, BRICK: tl.constexpr, NEAREST: tl.constexpr):
    """`corner` and `fraction` of a Sample."""
    EDGE: tl.constexpr = BRICK + 2
    i, fx = _first_corner(point.x, cell.x, BRICK, NEAREST)
    j, fy = _first_corner(point.y, cell.y, BRICK, NEAREST)
    k, fz = _first_corner(point.z, cell.z, BRICK, NEAREST)
    return brick.to(tl.int64) * (EDGE * EDGE * EDGE) + (i * EDGE + j) * EDGE + k, Vec3(fx, fy, fz)


@triton.jit
def _sample(grid, ray, k, alive, BRICK: tl.constexpr, NEAREST: tl.constexpr):
    """The `k`-th Sample of rays, and the number of the next one."""
    t = ray.enter + (k.to(tl.float32) + 0.5) * ray.step
    point = along(ray.origin, ray.direction, t)
    cell = _cells_of(grid, point, BRICK)
    owner = _owner(grid, cell, alive)
    o, d, inverse = ray.origin, ray.direction, ray.inverse
    radius = -tl.minimum(owner, 0)
    exit_y, exit_z = _cube_exit(o.y, d.y, inverse.y, cell.y, radius, BRICK), _cube_exit(o.z, d.z, inverse.z, cell.z, radius, BRICK)
    exit = tl.minimum(_cube_exit(o.x, d.x, inverse.x, cell.x, radius, BRICK), tl.minimum(exit_y, exit_z))
    after = tl.minimum(tl.maximum(tl.ceil((tl.minimum(exit, ray.leave) - ray.enter) / ray.step - 0.5), 0.0), 1e9).to(tl.int32)
    corner, fraction = _place_in_brick(point, cell, tl.maximum(owner, 0), BRICK, NEAREST)
    return Sample(t, ray.unit, ray.step, alive & (owner >= 0), corner, fraction), tl.where(owner < 0, tl.maximum(k + 1, after), k + 1)


@triton.jit
def _in_grid(ray, k):
    """Whether sample `k` lies in the grid."""
    return ray.enter + (k.to(tl.float32) + 0.5) * ray.step < ray.leave


@triton.jit
def march(
    grid, ray, live, scene, state, VISIT: tl.constexpr, BRICK: tl.constexpr, NEAREST: tl.constexpr, K: tl.constexpr, COLUMNS: tl.constexpr
):
    """Calls VISIT for the samples of rays that lie in bricks, front to back, until each ray is opaque or leaves the grid; returns the last state.

    VISIT  (scene, sample, state, BRICK, NEAREST, K, COLUMNS) -> state
    scene  what does not change along the ray
    state  a tuple with a `transmittance`, which ends a ray below STOP
    """
    k = tl.zeros_like(ray.enter).to(tl.int32)
    alive = live & _in_grid(ray, k)
    while tl.max(alive.to(tl.int32), 0) > 0:
        sample, k = _sample(grid, ray, k, alive, BRICK, NEAREST)
        if tl.max(sample.inside.to(tl.int32), 0) > 0:
            state = VISIT(scene, sample, state, BRICK, NEAREST, K, COLUMNS)
        alive = alive & (state.transmittance >= STOP) & _in_grid(ray, k)
    return state


@triton.jit
def cascade_grid(cascades, n):
    """The Grid of cascade n, its corner (Vec3) and the side of its voxels, voxels of cascade 0."""
    shape, place = cascades.shapes + 3 * n, cascades.place + 4 * n
    grid = Grid(cascades.owner + tl.load(cascades.first + n), Vec3(tl.load(shape), tl.load(shape + 1), tl.load(shape + 2)))
    return grid, Vec3(tl.load(place), tl.load(place + 1), tl.load(place + 2)), tl.load(place + 3)


@triton.jit
def in_cascade(point, corner, unit):
    """Points of cascade 0's voxel coordinates in those of a cascade."""
    return Vec3((point.x - corner.x) / unit, (point.y - corner.y) / unit, (point.z - corner.z) / unit)


@triton.jit
def _ray_in_cascade(cascades, n, origin, direction, BRICK: tl.constexpr):
    """The Grid of cascade n and rays in it."""
    grid, corner, unit = cascade_grid(cascades, n)
    return grid, ray_in_grid(grid, in_cascade(origin, corner, unit), direction, unit, cascades.step, BRICK)


@triton.jit
def march_cascades(
    cascades, origin, direction, live, scene, state, VISIT: tl.constexpr, CASCADES: tl.constexpr, BRICK: tl.constexpr, NEAREST: tl.constexpr,
    K: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """`march` through all parts of rays: part p lies in cascade |L - 1 - p|, before or behind the box that is cut out of that."""
    if CASCADES == 1:
        grid = Grid(cascades.owner, cascades.shape)
        state = march(grid, ray_in_grid(grid, origin, direction, 1.0, cascades.step, BRICK), live, scene, state, VISIT, BRICK, NEAREST, K, COLUMNS)
    else:
        OUTERMOST: tl.constexpr = CASCADES - 1
        for part in range(2 * CASCADES - 1):
            n = tl.maximum(part - OUTERMOST, OUTERMOST - part)
            grid, ray = _ray_in_cascade(cascades, n, origin, direction, BRICK)
            _, inner = _ray_in_cascade(cascades, tl.maximum(n - 1, 0), origin, direction, BRICK)
            meets = inner.leave > inner.enter
            leave = tl.where((part < OUTERMOST) & meets, 0.5 * inner.enter, ray.leave)
            enter = tl.where(part > OUTERMOST, tl.where(meets, 0.5 * inner.leave, ray.leave), ray.enter)
            through = Ray(ray.origin, ray.direction, ray.inverse, enter, leave, ray.unit, ray.step)
            state = march(grid, through, live & (state.transmittance >= STOP), scene, state, VISIT, BRICK, NEAREST, K, COLUMNS)
    return state


@triton.jit
def corner_weight(fraction, CORNER: tl.constexpr):
    """Trilinear weight of a corner, numbered with z fastest."""
    p: tl.constexpr = CORNER // 4
    q: tl.constexpr = CORNER // 2 % 2
    s: tl.constexpr = CORNER % 2
    return (fraction.x if p else 1 - fraction.x) * (fraction.y if q else 1 - fraction.y) * (fraction.z if s else 1 - fraction.z)


@triton.jit
def corner_place(corner, CORNER: tl.constexpr, BRICK: tl.constexpr):
    """Place of a corner in the arrays of bricks with border, from that of the lowest."""
    EDGE: tl.constexpr = BRICK + 2
    return corner + (((CORNER // 4) * EDGE + CORNER // 2 % 2) * EDGE + CORNER % 2)


@triton.jit
def density_at(grid, density, point, live, BRICK: tl.constexpr, NEAREST: tl.constexpr):
    """Density at any point: zero outside of the grid and in empty coarse cells."""
    n = grid.shape
    inside = live & (point.x >= 0) & (point.y >= 0) & (point.z >= 0) & (point.x < n.x * BRICK) & (point.y < n.y * BRICK) & (point.z < n.z * BRICK)
    cell = _cells_of(grid, point, BRICK)
    owner = _owner(grid, cell, inside)
    corner, fraction = _place_in_brick(point, cell, tl.maximum(owner, 0), BRICK, NEAREST)
    return interpolate_density(density, corner, fraction, owner >= 0, BRICK, NEAREST)


@triton.jit
def interpolate_density(density, corner, fraction, live, BRICK: tl.constexpr, NEAREST: tl.constexpr):
    """Density from values of bricks with border."""
    total = tl.zeros_like(fraction.x)
    for n in tl.static_range(1 if NEAREST else 8):
        total += corner_weight(fraction, n) * tl.load(density + corner_place(corner, n, BRICK), live, other=0.0).to(tl.float32)
    return total


@triton.jit
def interpolate_harmonics(index, sh, sample, live, column, WIDTH: tl.constexpr, BRICK: tl.constexpr, NEAREST: tl.constexpr):
    """Coefficients (R, C) of samples summed over the stored corners by their weights, and the sum of these weights (R,), which is positive.

    sh  rows of WIDTH coefficients; columns beyond it are zero
    """
    mixed = tl.zeros_like(sample.fraction.x)[:, None] + tl.zeros_like(column)[None, :].to(tl.float32)
    total = tl.zeros_like(sample.fraction.x)
    for n in tl.static_range(1 if NEAREST else 8):
        voxel = tl.load(index + corner_place(sample.corner, n, BRICK), live, other=-1)
        weight = tl.where(voxel >= 0, corner_weight(sample.fraction, n), 0.0)
        total += weight
        row = tl.load(sh + voxel.to(tl.int64)[:, None] * WIDTH + column[None, :], (voxel >= 0)[:, None] & (column < WIDTH)[None, :], other=0.0)
        mixed += weight[:, None] * row.to(tl.float32)
    return mixed, tl.maximum(total, 1e-20)


@triton.jit
def colour_of(mixed, total, basis, channel):
    """Colours of samples (Vec3) from `interpolate_harmonics`; `channel` (C,) of each column, 0 to 2."""
    terms = mixed * basis
    red = sigmoid(tl.sum(tl.where((channel == 0)[None, :], terms, 0.0), 1) / total)
    green = sigmoid(tl.sum(tl.where((channel == 1)[None, :], terms, 0.0), 1) / total)
    blue = sigmoid(tl.sum(tl.where((channel == 2)[None, :], terms, 0.0), 1) / total)
    return Vec3(red, green, blue)
