"""Pictures from packed trees (numba): rays of a camera, or rays as they come, in tiles of neighbours.

The rays of a tile lie in a cone. Where the cone's widening ball meets nothing but empty cells, none of them needs to look: all start where it
first might meet something, and a tile that meets nothing is finished. That skips samples that are zero and changes no value.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from efficientnerf.kernels.cpu_march import STEP, march, normal_into

TILE = 8  # rays along each side of a tile
LEAST_ADVANCE = 0.5  # voxels: a cone that advances by less has arrived
MOST_ADVANCES = 64


class Shot(NamedTuple):
    """Rays in rows and columns: of a pinhole camera, or of a camera with a table of directions, or as they come.

    lens      (4,) fx, fy, cx, cy, pixels: read where neither `sights` nor `starts` are given
    pitch     distance of neighbouring rays, pixels; the first ray lies half of it from the picture's left and upper border
    first     row of the first ray
    turn      (3, 3) the camera's rotation, world from camera
    centre    (3,) where it stands, voxel coordinates
    sights    (H, W, 3) float32 unit directions in the camera's frame, or (0, 0, 3)
    starts    (H, W, 3) origins, voxel coordinates, or (0, 0, 3)
    alongs    (H, W, 3) unit directions, with `starts`
    looking   (H, W, 3) float32 directions that the harmonics are asked for, or (0, 0, 3): those of the rays
    """

    lens: np.ndarray
    pitch: float
    first: int
    turn: np.ndarray
    centre: np.ndarray
    sights: np.ndarray
    starts: np.ndarray
    alongs: np.ndarray
    looking: np.ndarray


@numba.njit(cache=True, error_model="numpy")
def _entry(ox, oy, oz, dx, dy, dz, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Where a ray enters and leaves a box from 0 to (nx, ny, nz), from its origin on; it leaves first where it misses."""
    t0, t1 = 0.0, np.inf
    if dx != 0:
        inverse = 1 / dx
        one, other = -ox * inverse, (nx - ox) * inverse
        t0, t1 = max(t0, min(one, other)), min(t1, max(one, other))
    elif not 0 <= ox <= nx:
        t1 = -1.0
    if dy != 0:
        inverse = 1 / dy
        one, other = -oy * inverse, (ny - oy) * inverse
        t0, t1 = max(t0, min(one, other)), min(t1, max(one, other))
    elif not 0 <= oy <= ny:
        t1 = -1.0
    if dz != 0:
        inverse = 1 / dz
        one, other = -oz * inverse, (nz - oz) * inverse
        t0, t1 = max(t0, min(one, other)), min(t1, max(one, other))
    elif not 0 <= oz <= nz:
        t1 = -1.0
    return t0, t1


@numba.njit(cache=True, error_model="numpy")
def _free(x, y, z, brick, cell):  # type: ignore[no-untyped-def]
    """Radius of a ball round a point, voxel coordinates, that touches no occupied cell."""
    nx, ny, nz = cell.shape[0] * brick, cell.shape[1] * brick, cell.shape[2] * brick
    # What lies in the box is no nearer to the point than to the point's nearest in the box.
    qx, qy, qz = min(max(x, 0.0), nx), min(max(y, 0.0), ny), min(max(z, 0.0), nz)
    away = (x - qx) ** 2 + (y - qy) ** 2 + (z - qz) ** 2
    a, e, c = min(int(qx) // brick, cell.shape[0] - 1), min(int(qy) // brick, cell.shape[1] - 1), min(int(qz) // brick, cell.shape[2] - 1)
    leap = -1 - cell[a, e, c]
    inner = 0.0
    if leap > 0:
        ux, uy, uz = qx - a * brick, qy - e * brick, qz - c * brick
        inner = (leap - 1) * brick + min(min(ux, brick - ux), min(uy, brick - uy), min(uz, brick - uz))
    return np.sqrt(away + inner * inner)


@numba.njit(cache=True, error_model="numpy")
def _clear_until(ox, oy, oz, dx, dy, dz, spread, widening, brick, cell):  # type: ignore[no-untyped-def]
    """The parameter up to which rays see nothing; infinity where they never do.

    o, d      a ray, voxel coordinates
    spread    how far the other rays' origins lie from o at most
    widening  how far their directions lie from d at most
    """
    nx, ny, nz = cell.shape[0] * brick / 2, cell.shape[1] * brick / 2, cell.shape[2] * brick / 2
    beyond = np.sqrt((ox - nx) ** 2 + (oy - ny) ** 2 + (oz - nz) ** 2) + np.sqrt(nx * nx + ny * ny + nz * nz) + 2 * spread
    t = 0.0
    for _ in range(MOST_ADVANCES):
        # At t + a a ray is no farther than spread + (t + a) * widening + a from the point here.
        advance = (_free(ox + t * dx, oy + t * dy, oz + t * dz, brick, cell) - spread - t * widening) / (1 + widening)
        if not advance > LEAST_ADVANCE:
            return t
        t += advance
        if t > beyond:
            return np.inf
    return t


@numba.njit(cache=True, inline="always", error_model="numpy")
def _turned(turn, x, y, z):  # type: ignore[no-untyped-def]
    return (
        turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z,
        turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z,
        turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z,
    )


@numba.njit(cache=True, inline="always", error_model="numpy")
def _sight(x, y, lens, turn):  # type: ignore[no-untyped-def]
    """Unit direction that the position (x, y) in the picture sees, and its part along the view axis."""
    u, v = (x - lens[2]) / lens[0], (y - lens[3]) / lens[1]
    slant = 1 / np.sqrt(u * u + v * v + 1)
    dx, dy, dz = _turned(turn, u * slant, v * slant, slant)
    return dx, dy, dz, slant


@numba.njit(cache=True, error_model="numpy")
def _tile_of_pinhole(top, low, left, right, pitch, lens, turn, centre, brick, cell):  # type: ignore[no-untyped-def]
    """`_clear_until` of the rays of some rows and columns: those in the corners lie farthest from the middle."""
    ax, ay, az, _ = _sight((left + right) / 2 * pitch, (top + low) / 2 * pitch, lens, turn)
    most = 0.0
    for n in range(4):
        row, column = top if n & 1 else low, left if n & 2 else right
        dx, dy, dz, _ = _sight(column * pitch, row * pitch, lens, turn)
        most = max(most, (dx - ax) ** 2 + (dy - ay) ** 2 + (dz - az) ** 2)
    return _clear_until(centre[0], centre[1], centre[2], ax, ay, az, 0.0, np.sqrt(most), brick, cell)


@numba.njit(cache=True, error_model="numpy")
def _tile_of_sights(top, low, left, right, sights, turn, centre, brick, cell):  # type: ignore[no-untyped-def]
    """The same of directions in the camera's frame."""
    m = sights[(top + low) // 2, (left + right) // 2]
    most = 0.0
    for row in range(top, low):
        for column in range(left, right):
            s = sights[row, column]
            most = max(most, (s[0] - m[0]) ** 2 + (s[1] - m[1]) ** 2 + (s[2] - m[2]) ** 2)
    ax, ay, az = _turned(turn, m[0], m[1], m[2])
    return _clear_until(centre[0], centre[1], centre[2], ax, ay, az, 0.0, np.sqrt(most), brick, cell)


@numba.njit(cache=True, error_model="numpy")
def _tile_of_rays(top, low, left, right, starts, alongs, brick, cell):  # type: ignore[no-untyped-def]
    """The same of rays as they come."""
    o, d = starts[(top + low) // 2, (left + right) // 2], alongs[(top + low) // 2, (left + right) // 2]
    spread = widening = 0.0
    for row in range(top, low):
        for column in range(left, right):
            s, a = starts[row, column], alongs[row, column]
            spread = max(spread, (s[0] - o[0]) ** 2 + (s[1] - o[1]) ** 2 + (s[2] - o[2]) ** 2)
            widening = max(widening, (a[0] - d[0]) ** 2 + (a[1] - d[1]) ** 2 + (a[2] - d[2]) ** 2)
    return _clear_until(o[0], o[1], o[2], d[0], d[1], d[2], np.sqrt(spread), np.sqrt(widening), brick, cell)


@numba.njit(cache=True, error_model="numpy")
def _tile(top, low, left, right, shot, brick, cell):  # type: ignore[no-untyped-def]
    """The parameter up to which the rays of some rows and columns see nothing."""
    if len(shot.starts) > 0:
        return _tile_of_rays(top, low, left, right, shot.starts, shot.alongs, brick, cell)
    if len(shot.sights) > 0:
        return _tile_of_sights(top, low, left, right, shot.sights, shot.turn, shot.centre, brick, cell)
    rows, columns = (shot.first + top + 0.5, shot.first + low - 0.5), (left + 0.5, right - 0.5)
    return _tile_of_pinhole(rows[0], rows[1], columns[0], columns[1], shot.pitch, shot.lens, shot.turn, shot.centre, brick, cell)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _ray(row, column, shot):  # type: ignore[no-untyped-def]
    """Origin, direction, and how far along the view axis a step along the ray leads."""
    if len(shot.starts) > 0:
        o, d = shot.starts[row, column], shot.alongs[row, column]
        return o[0], o[1], o[2], d[0], d[1], d[2], 1.0
    if len(shot.sights) > 0:
        s = shot.sights[row, column]
        dx, dy, dz = _turned(shot.turn, s[0], s[1], s[2])
        return shot.centre[0], shot.centre[1], shot.centre[2], dx, dy, dz, np.float64(s[2])
    dx, dy, dz, slant = _sight((column + 0.5) * shot.pitch, (shot.first + row + 0.5) * shot.pitch, shot.lens, shot.turn)
    return shot.centre[0], shot.centre[1], shot.centre[2], dx, dy, dz, slant


@numba.njit(cache=True, parallel=True, error_model="numpy")
def trace(shot, behind, brick, grid, degree, units, tile, threads, colour, opacity, depth, normal, work):  # type: ignore[no-untyped-def]
    """What rays in rows and columns see, into colour (H, W, 3), opacity (H, W), depth (H, W), normal (H, W, 3) or (0, 0, 3) where none is wanted.

    behind  (3,) float32 colour to composite over
    units   world units per voxel
    tile    (rows, columns) of a tile
    work    (H, W, 4) int32, or (0, 0, 4) where it is of no interest: cells looked at, samples tested, samples interpolated, colours looked up

    Depth is along the view axis for a camera and along the ray for rays as they come, world units.
    """
    nx, ny, nz = grid.cell.shape[0] * brick, grid.cell.shape[1] * brick, grid.cell.shape[2] * brick
    height, width = opacity.shape
    strips = (height + tile[0] - 1) // tile[0]
    share = (strips + threads - 1) // threads
    for part in numba.prange(share * threads):
        # A thread gets a run of parts: every so many-th strip of the picture, for strips of the sky cost next to nothing.
        top = (part % share * threads + part // share) * tile[0]
        low = min(top + tile[0], height)
        basis = np.zeros((3, grid.sh.shape[1]), np.float32)
        look, out = np.empty(3, np.float32), np.empty(9, np.float32)
        for left in range(0, width if top < height else 0, tile[1]):
            right = min(left + tile[1], width)
            clear = _tile(top, low, left, right, shot, brick, grid.cell)
            for row in range(top, low):
                for column in range(left, right):
                    if clear == np.inf:
                        colour[row, column, 0], colour[row, column, 1], colour[row, column, 2] = behind[0], behind[1], behind[2]
                        opacity[row, column], depth[row, column] = np.float32(0), np.float32(np.inf)
                        if len(normal) > 0:
                            normal[row, column, 0] = normal[row, column, 1] = normal[row, column, 2] = np.float32(0)
                        continue
                    ox, oy, oz, dx, dy, dz, slant = _ray(row, column, shot)
                    look[0], look[1], look[2] = dx, dy, dz
                    if len(shot.looking) > 0:
                        look[0], look[1], look[2] = shot.looking[row, column, 0], shot.looking[row, column, 1], shot.looking[row, column, 2]
                    t0, t1 = _entry(ox, oy, oz, dx, dy, dz, nx, ny, nz)
                    last = int(np.ceil((t1 - t0) / STEP - 0.5)) if t1 > t0 else 0
                    begin = int(min(max((clear - t0) / STEP - 0.5, 0.0), last))
                    ex, ey, ez = np.float32(ox + t0 * dx), np.float32(oy + t0 * dy), np.float32(oz + t0 * dz)
                    ax, ay, az = np.float32(dx), np.float32(dy), np.float32(dz)
                    march(ex, ey, ez, ax, ay, az, begin, last, np.float32(STEP * units), brick, grid, look, degree, basis, out)
                    through = np.float32(1) - out[3]
                    for c in range(3):
                        colour[row, column, c] = out[c] + through * behind[c]
                    opacity[row, column] = out[3]
                    depth[row, column] = (t0 + out[4]) * slant * units
                    if len(work) > 0:
                        for n in range(4):
                            work[row, column, n] = out[5 + n]
                    if len(normal) > 0:
                        if out[4] < np.inf:
                            normal_into(ex + out[4] * ax, ey + out[4] * ay, ez + out[4] * az, brick, grid.cell, grid.density, normal[row, column])
                        else:
                            normal[row, column, 0] = normal[row, column, 1] = normal[row, column, 2] = np.float32(0)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def merge(supersample, fine_colour, fine_opacity, fine_depth, fine_normal, colour, opacity, depth, normal):  # type: ignore[no-untyped-def]
    """Pixels from their supersample^2 rays: means of colour and opacity, the depth that half of them do not pass, the mean normal.

    The nearest half of the rays decides on the depth; the mean of a near and a far surface would lie on neither.
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
            solid = o * one >= np.float32(0.5) and hits > 0
            # Fewer than half may hit where the others are half transparent.
            depth[row, column] = sorted_depth[min(hits - 1, (count - 1) // 2)] if solid else np.float32(np.inf)
            if len(normal) > 0:
                length = np.sqrt(x * x + y * y + z * z)
                share = np.float32(1) / length if solid and length > 0 else np.float32(0)
                normal[row, column, 0], normal[row, column, 1], normal[row, column, 2] = x * share, y * share, z * share
