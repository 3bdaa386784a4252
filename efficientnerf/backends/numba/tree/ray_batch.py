"""Rays in rows and columns (numba): of a pinhole camera, of a camera with a table of directions, or given one by one; and how far a tile of them is clear.

The rays of a camera into a tree in normalised device coordinates are warped tile by tile, as they are traced.

The rays of a tile lie in a cone. As long as the ball in which the cone widens meets only empty cells, no ray of the tile can meet density: all start where it
first may, and a tile that never may is done. That skips samples of density zero and changes no value.
"""

from typing import Any, NamedTuple

import numpy as np

from efficientnerf.backends.numba.rays import warp_ray, world_distance, world_normal
from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.tree.packets import layout
from efficientnerf.backends.numba.vector.maths import sqrt
from efficientnerf.backends.numba.vector.memory import advanced

MIN_ADVANCE = 2.0  # voxels: a cone that advances by less has arrived; docs/experiments/renderer.md
MAX_ADVANCES = 64
PINHOLE, DIRECTION_TABLE, GIVEN_RAYS = 0, 1, 2


class RayBatch(NamedTuple):
    """Rays in H rows and W columns, see the module; arrays, or in kernels pointers to them, of which those that a kind of rays does not need are empty."""

    kind: int  # PINHOLE, DIRECTION_TABLE or GIVEN_RAYS
    width: int  # W of the arrays
    fx: float  # of a pinhole, pixels
    fy: float
    cx: float
    cy: float
    pitch: float  # distance of neighbouring rays, pixels; the first ray lies half of it from the left and upper border of the image
    first_row: int  # row of the first ray
    rotation: Any  # (3, 3) world from camera
    x: float  # the camera's centre, voxel coordinates of cascade 0; in the world for a tree in normalised device coordinates
    y: float
    z: float
    camera_directions: Any  # (H, W, 3) float32 unit directions in the camera's frame, of a table
    origins: Any  # (H, W, 3) voxel coordinates of cascade 0, and
    directions: Any  # (H, W, 3) unit directions, of given rays
    has_sh_directions: bool
    sh_directions: Any  # (H, W, 3) float32 directions that harmonics are evaluated along, if not along the rays
    warped: bool  # whether they go through `tile_rays` before they are traced, into a tree in normalised device coordinates
    ndc: Any  # (19,) then: `rays.ndc_numbers`, the corner and the voxel of its grid


def given_rays(origins: np.ndarray, directions: np.ndarray, sh_directions: np.ndarray | None = None) -> RayBatch:
    """Rays (H, W, 3), see `RayBatch`."""
    none = np.zeros((0, 0, 3), np.float32)
    has_other = sh_directions is not None and len(sh_directions) > 0
    return RayBatch(
        GIVEN_RAYS, origins.shape[1], 0.0, 0.0, 0.0, 0.0, 1.0, 0, np.eye(3), 0.0, 0.0, 0.0, none, origins, directions,
        has_other, none if sh_directions is None else sh_directions, False, np.zeros(0),
    )  # fmt: skip


@numba.njit(cache=True, inline="always", error_model="numpy")
def _rotate(r, x, y, z):
    return r[0] * x + r[1] * y + r[2] * z, r[3] * x + r[4] * y + r[5] * z, r[6] * x + r[7] * y + r[8] * z


@numba.njit(cache=True, inline="always", error_model="numpy")
def pinhole_direction(x, y, rays):
    """Unit direction through (x, y), pixels, and its component along the view axis; of one ray or of those in lanes."""
    u, v = (x - rays.cx) / rays.fx, (y - rays.cy) / rays.fy
    cosine = 1.0 / sqrt(u * u + v * v + 1.0)
    dx, dy, dz = _rotate(rays.rotation, u * cosine, v * cosine, cosine)
    return dx, dy, dz, cosine


@numba.njit(cache=True, inline="always", error_model="numpy")
def ray_at(row, column, rays):
    """Origin, direction, and cosine to the view axis, by which a distance along the ray becomes a depth; 1 for given rays."""
    p = 3 * (row * rays.width + column)
    if rays.kind == GIVEN_RAYS:
        o, d = rays.origins, rays.directions
        return o[p], o[p + 1], o[p + 2], d[p], d[p + 1], d[p + 2], 1.0
    if rays.kind == DIRECTION_TABLE:
        dx, dy, dz = _rotate(rays.rotation, rays.camera_directions[p], rays.camera_directions[p + 1], rays.camera_directions[p + 2])
        return rays.x, rays.y, rays.z, dx, dy, dz, np.float64(rays.camera_directions[p + 2])
    dx, dy, dz, cosine = pinhole_direction((column + 0.5) * rays.pitch, (rays.first_row + row + 0.5) * rays.pitch, rays)
    return rays.x, rays.y, rays.z, dx, dy, dz, cosine


@numba.njit(cache=True, error_model="numpy")
def tile_rays(top, low, left, right, rays, warped, looking):
    """The rays of rows top to low and columns left to right in the frame of the tree: these, or for `warped` rays given ones, of this tile alone.

    warped, looking  float64 and float32 scratch for a tile, see `layout`: into it go the rays and what leads back to the world
    """
    if not rays.warped:
        return rays
    ndc, width = rays.ndc, right - left
    per_voxel = 1 / ndc[18]
    for row in range(top, low):
        for column in range(left, right):
            x, y, z, dx, dy, dz, cosine = ray_at(row, column, rays)
            n = (row - top) * width + column - left
            looking[3 * n], looking[3 * n + 1], looking[3 * n + 2] = dx, dy, dz
            x, y, z, dx, dy, dz, begin, ds_dt, dlogz_dt = warp_ray(x, y, z, dx, dy, dz, ndc)
            origin, along = layout.WARPED_ORIGIN + 3 * n, layout.WARPED_DIRECTION + 3 * n
            warped[origin], warped[origin + 1], warped[origin + 2] = (x - ndc[15]) * per_voxel, (y - ndc[16]) * per_voxel, (z - ndc[17]) * per_voxel
            warped[along], warped[along + 1], warped[along + 2] = dx, dy, dz
            warped[layout.WARPED_BEGIN + n], warped[layout.WARPED_SPEED + n], warped[layout.WARPED_BEND + n] = begin, ds_dt, dlogz_dt
            warped[layout.WARPED_COSINE + n] = cosine
    first = -3 * (top * width + left)  # as if the tile were a part of the image
    return RayBatch(
        np.int64(GIVEN_RAYS),  # type: ignore[arg-type]
        width, rays.fx, rays.fy, rays.cx, rays.cy, rays.pitch, rays.first_row, rays.rotation, rays.x, rays.y, rays.z,
        rays.camera_directions, advanced(warped, layout.WARPED_ORIGIN + first), advanced(warped, layout.WARPED_DIRECTION + first),
        True, advanced(looking, first), True, rays.ndc,
    )  # fmt: skip


@numba.njit(cache=True, inline="always", error_model="numpy")
def world_depth(n, along, warped):
    """Depth along the view axis, float32, of a point `along` the n-th ray of a tile that `tile_rays` warped, units of the frame."""
    distance = world_distance(np.float64(along), warped[layout.WARPED_BEGIN + n], warped[layout.WARPED_SPEED + n], warped[layout.WARPED_BEND + n])
    return np.float32(np.float64(distance) * warped[layout.WARPED_COSINE + n])


@numba.njit(cache=True, inline="always", error_model="numpy")
def normal_in_world(n, along, nx, ny, nz, ndc, warped):
    """The normal of the frame (nx, ny, nz) at that point as one of the world."""
    at, s = 3 * n, np.float64(along)
    x = warped[layout.WARPED_ORIGIN + at] * ndc[18] + ndc[15] + s * warped[layout.WARPED_DIRECTION + at]
    y = warped[layout.WARPED_ORIGIN + at + 1] * ndc[18] + ndc[16] + s * warped[layout.WARPED_DIRECTION + at + 1]
    z = warped[layout.WARPED_ORIGIN + at + 2] * ndc[18] + ndc[17] + s * warped[layout.WARPED_DIRECTION + at + 2]
    return world_normal(x, y, z, np.float64(nx), np.float64(ny), np.float64(nz), ndc)


@numba.njit(cache=True, inline="always", error_model="numpy")
def in_cascade(x, y, z, grid):
    """Voxel coordinates of a point, of those in cascade 0."""
    return x / grid.ratio + grid.shift_x, y / grid.ratio + grid.shift_y, z / grid.ratio + grid.shift_z


@numba.njit(cache=True, error_model="numpy")
def _empty_radius(x, y, z, grid):
    """Radius of a ball around a point, voxel coordinates, that touches no occupied cell."""
    brick = grid.brick
    nx, ny, nz = grid.nx * brick, grid.ny * brick, grid.nz * brick
    # Anything in the box is at least as far from the point as from its nearest point in the box, q, and that far from q.
    qx, qy, qz = min(max(x, 0.0), nx), min(max(y, 0.0), ny), min(max(z, 0.0), nz)
    outside = (x - qx) ** 2 + (y - qy) ** 2 + (z - qz) ** 2
    per_brick = 1 / brick
    a, e, c = min(int(qx * per_brick), grid.nx - 1), min(int(qy * per_brick), grid.ny - 1), min(int(qz * per_brick), grid.nz - 1)
    leap = np.int64(grid.leap[(a * grid.ny + e) * grid.nz + c])
    inner = 0.0
    if leap > 0:
        ux, uy, uz = qx - a * brick, qy - e * brick, qz - c * brick
        inner = (leap - 1) * brick + min(min(ux, brick - ux), min(uy, brick - uy), min(uz, brick - uz))
    return np.sqrt(outside + inner * inner) if outside > 0 else inner


@numba.njit(cache=True, error_model="numpy")
def _clear_cone(origin, direction, radius, widening, t, grid):
    """Distance up to which all rays of a cone are clear; infinity where they never meet an occupied cell.

    origin, direction  (x, y, z) of its axis, voxel coordinates of cascade 0
    radius             distance of the rays' origins from `origin`, at most, voxels of cascade 0
    widening           distance of their unit directions from `direction`, at most
    t                  distance up to which they are known to be clear, voxels of the grid, as is what is returned
    """
    ox, oy, oz = in_cascade(origin[0], origin[1], origin[2], grid)
    radius /= grid.ratio
    dx, dy, dz = direction
    if not np.isfinite(ox + oy + oz + dx + dy + dz + radius + widening + t):  # NaN must not become an index
        return t
    nx, ny, nz = grid.nx * grid.brick / 2, grid.ny * grid.brick / 2, grid.nz * grid.brick / 2
    beyond = np.sqrt((ox - nx) ** 2 + (oy - ny) ** 2 + (oz - nz) ** 2) + np.sqrt(nx * nx + ny * ny + nz * nz) + 2 * radius
    slowed = 1 / (1 + widening)
    for _ in range(MAX_ADVANCES):
        # At t + a a ray is within radius + (t + a) * widening + a of the point here.
        advance = (_empty_radius(ox + t * dx, oy + t * dy, oz + t * dz, grid) - radius - t * widening) * slowed
        if not advance > MIN_ADVANCE:
            return t
        t += advance
        if t > beyond:
            return np.inf
    return t


@numba.njit(cache=True, error_model="numpy")
def _clear_pinhole(top, low, left, right, since, rays, grid):
    """`clear_distance` for a pinhole camera: the corners of the tile are farthest from its middle."""
    ax, ay, az, _ = pinhole_direction((left + right) / 2 * rays.pitch, (top + low) / 2 * rays.pitch, rays)
    widening = 0.0
    for n in range(4):
        row, column = top if n & 1 else low, left if n & 2 else right
        dx, dy, dz, _ = pinhole_direction(column * rays.pitch, row * rays.pitch, rays)
        widening = max(widening, (dx - ax) ** 2 + (dy - ay) ** 2 + (dz - az) ** 2)
    return _clear_cone((rays.x, rays.y, rays.z), (ax, ay, az), 0.0, np.sqrt(widening), since, grid)


@numba.njit(cache=True, error_model="numpy")
def _clear_directions(top, low, left, right, since, rays, grid):
    """The same for a table of directions."""
    d = rays.camera_directions
    m = 3 * ((top + low) // 2 * rays.width + (left + right) // 2)
    widening = 0.0
    for row in range(top, low):
        for column in range(left, right):
            s = 3 * (row * rays.width + column)
            widening = max(widening, (d[s] - d[m]) ** 2 + (d[s + 1] - d[m + 1]) ** 2 + (d[s + 2] - d[m + 2]) ** 2)
    ax, ay, az = _rotate(rays.rotation, d[m], d[m + 1], d[m + 2])
    return _clear_cone((rays.x, rays.y, rays.z), (ax, ay, az), 0.0, np.sqrt(widening), since, grid)


@numba.njit(cache=True, error_model="numpy")
def _clear_rays(top, low, left, right, since, rays, grid):
    """The same for given rays."""
    o, d = rays.origins, rays.directions
    m = 3 * ((top + low) // 2 * rays.width + (left + right) // 2)
    radius = widening = 0.0
    for row in range(top, low):
        for column in range(left, right):
            s = 3 * (row * rays.width + column)
            radius = max(radius, (o[s] - o[m]) ** 2 + (o[s + 1] - o[m + 1]) ** 2 + (o[s + 2] - o[m + 2]) ** 2)
            widening = max(widening, (d[s] - d[m]) ** 2 + (d[s + 1] - d[m + 1]) ** 2 + (d[s + 2] - d[m + 2]) ** 2)
    return _clear_cone((o[m], o[m + 1], o[m + 2]), (d[m], d[m + 1], d[m + 2]), np.sqrt(radius), np.sqrt(widening), since, grid)


@numba.njit(cache=True, error_model="numpy")
def clear_distance(top, low, left, right, since, rays, grid):
    """Distance, voxels of the grid, up to which the rays of rows top to low and columns left to right are clear in it, at least `since`."""
    if rays.kind == GIVEN_RAYS:
        return _clear_rays(top, low, left, right, since, rays, grid)
    if rays.kind == DIRECTION_TABLE:
        return _clear_directions(top, low, left, right, since, rays, grid)
    return _clear_pinhole(rays.first_row + top + 0.5, rays.first_row + low - 0.5, left + 0.5, right - 0.5, since, rays, grid)
