"""Pictures from packed trees (numba): rays of a camera, or rays as they come, in tiles of neighbours.

The rays of a tile lie in a cone. Where the cone's widening ball meets nothing but empty cells, none of them needs to look: all start where it
first might meet something, and a tile that meets nothing is finished. That skips samples that are zero and changes no value.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.simd import pointer
from efficientnerf.backends.numba.tree.blocks import QUEUE, Pool, View, grid_of
from efficientnerf.backends.numba.tree.march import STEP, Bench, march, normal_into

TILE = 8  # rays along each side of a tile
PART = 4  # rays along each side of a part of one
RUNS = 32  # of neighbouring tiles that a thread takes
LEAST_ADVANCE = 0.5  # voxels: a cone that advances by less has arrived
MOST_ADVANCES = 64
PINHOLE, SIGHTS, FREE = 0, 1, 2


class Shot(NamedTuple):
    """Rays in rows and columns: of a pinhole camera, or of a camera with a table of directions, or as they come.

    lens      (4,) fx, fy, cx, cy, pixels: read where neither `sights` nor `starts` are given
    pitch     distance of neighbouring rays, pixels; the first ray lies half of it from the picture's left and upper border
    first     row of the first ray
    turn      (3, 3) the camera's rotation, world from camera
    centre    (3,) where it stands, voxel coordinates
    toward    (3, 4) along which direction points are seen, see `cpu_blocks.View`
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
    toward: np.ndarray
    sights: np.ndarray
    starts: np.ndarray
    alongs: np.ndarray
    looking: np.ndarray


class Rays(NamedTuple):
    """A Shot whose arrays are pointers; `kind` is PINHOLE, SIGHTS or FREE, `looks` whether `looking` is there."""

    kind: int
    width: int
    fx: float
    fy: float
    cx: float
    cy: float
    pitch: float
    first: int
    turn: Any
    x: float
    y: float
    z: float
    sights: Any
    starts: Any
    alongs: Any
    looks: bool
    looking: Any


@numba.njit(cache=True, inline="always", error_model="numpy")
def rays_of(shot):  # type: ignore[no-untyped-def]
    """The arrays of a Shot as pointers."""
    kind = FREE if len(shot.starts) > 0 else SIGHTS if len(shot.sights) > 0 else PINHOLE
    width = shot.starts.shape[1] if kind == FREE else shot.sights.shape[1]
    lens, centre = shot.lens, shot.centre
    return Rays(
        kind, width, lens[0], lens[1], lens[2], lens[3], shot.pitch, shot.first, pointer(shot.turn), centre[0], centre[1], centre[2],
        pointer(shot.sights), pointer(shot.starts), pointer(shot.alongs), len(shot.looking) > 0, pointer(shot.looking),
    )  # fmt: skip


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
def _free(x, y, z, grid):  # type: ignore[no-untyped-def]
    """Radius of a ball round a point, voxel coordinates, that touches no occupied cell."""
    brick = grid.brick
    nx, ny, nz = grid.nx * brick, grid.ny * brick, grid.nz * brick
    # What lies in the box is no nearer to the point than to the point's nearest in the box.
    qx, qy, qz = min(max(x, 0.0), nx), min(max(y, 0.0), ny), min(max(z, 0.0), nz)
    away = (x - qx) ** 2 + (y - qy) ** 2 + (z - qz) ** 2
    part = 1 / brick
    a, e, c = min(int(qx * part), grid.nx - 1), min(int(qy * part), grid.ny - 1), min(int(qz * part), grid.nz - 1)
    leap = np.int64(grid.leap[(a * grid.ny + e) * grid.nz + c])
    inner = 0.0
    if leap > 0:
        ux, uy, uz = qx - a * brick, qy - e * brick, qz - c * brick
        inner = (leap - 1) * brick + min(min(ux, brick - ux), min(uy, brick - uy), min(uz, brick - uz))
    return np.sqrt(away + inner * inner)


@numba.njit(cache=True, error_model="numpy")
def _clear_until(ox, oy, oz, dx, dy, dz, spread, widening, t, grid):  # type: ignore[no-untyped-def]
    """The parameter up to which rays see nothing; infinity where they never do.

    o, d      a ray, voxel coordinates
    spread    how far the other rays' origins lie from o at most
    widening  how far their directions lie from d at most
    t         until where this is known
    """
    nx, ny, nz = grid.nx * grid.brick / 2, grid.ny * grid.brick / 2, grid.nz * grid.brick / 2
    beyond = np.sqrt((ox - nx) ** 2 + (oy - ny) ** 2 + (oz - nz) ** 2) + np.sqrt(nx * nx + ny * ny + nz * nz) + 2 * spread
    for _ in range(MOST_ADVANCES):
        # At t + a a ray is no farther than spread + (t + a) * widening + a from the point here.
        advance = (_free(ox + t * dx, oy + t * dy, oz + t * dz, grid) - spread - t * widening) / (1 + widening)
        if not advance > LEAST_ADVANCE:
            return t
        t += advance
        if t > beyond:
            return np.inf
    return t


@numba.njit(cache=True, inline="always", error_model="numpy")
def _turned(turn, x, y, z):  # type: ignore[no-untyped-def]
    return turn[0] * x + turn[1] * y + turn[2] * z, turn[3] * x + turn[4] * y + turn[5] * z, turn[6] * x + turn[7] * y + turn[8] * z


@numba.njit(cache=True, inline="always", error_model="numpy")
def _sight(x, y, rays):  # type: ignore[no-untyped-def]
    """Unit direction that the position (x, y) in the picture sees, and its part along the view axis."""
    u, v = (x - rays.cx) / rays.fx, (y - rays.cy) / rays.fy
    slant = 1 / np.sqrt(u * u + v * v + 1)
    dx, dy, dz = _turned(rays.turn, u * slant, v * slant, slant)
    return dx, dy, dz, slant


@numba.njit(cache=True, error_model="numpy")
def _tile_of_pinhole(top, low, left, right, since, rays, grid):  # type: ignore[no-untyped-def]
    """`_clear_until` of the rays of some rows and columns: those in the corners lie farthest from the middle."""
    ax, ay, az, _ = _sight((left + right) / 2 * rays.pitch, (top + low) / 2 * rays.pitch, rays)
    most = 0.0
    for n in range(4):
        row, column = top if n & 1 else low, left if n & 2 else right
        dx, dy, dz, _ = _sight(column * rays.pitch, row * rays.pitch, rays)
        most = max(most, (dx - ax) ** 2 + (dy - ay) ** 2 + (dz - az) ** 2)
    return _clear_until(rays.x, rays.y, rays.z, ax, ay, az, 0.0, np.sqrt(most), since, grid)


@numba.njit(cache=True, error_model="numpy")
def _tile_of_sights(top, low, left, right, since, rays, grid):  # type: ignore[no-untyped-def]
    """The same of directions in the camera's frame."""
    sights = rays.sights
    m = 3 * ((top + low) // 2 * rays.width + (left + right) // 2)
    most = 0.0
    for row in range(top, low):
        for column in range(left, right):
            s = 3 * (row * rays.width + column)
            most = max(most, (sights[s] - sights[m]) ** 2 + (sights[s + 1] - sights[m + 1]) ** 2 + (sights[s + 2] - sights[m + 2]) ** 2)
    ax, ay, az = _turned(rays.turn, sights[m], sights[m + 1], sights[m + 2])
    return _clear_until(rays.x, rays.y, rays.z, ax, ay, az, 0.0, np.sqrt(most), since, grid)


@numba.njit(cache=True, error_model="numpy")
def _tile_of_rays(top, low, left, right, since, rays, grid):  # type: ignore[no-untyped-def]
    """The same of rays as they come."""
    o, d = rays.starts, rays.alongs
    m = 3 * ((top + low) // 2 * rays.width + (left + right) // 2)
    spread = widening = 0.0
    for row in range(top, low):
        for column in range(left, right):
            s = 3 * (row * rays.width + column)
            spread = max(spread, (o[s] - o[m]) ** 2 + (o[s + 1] - o[m + 1]) ** 2 + (o[s + 2] - o[m + 2]) ** 2)
            widening = max(widening, (d[s] - d[m]) ** 2 + (d[s + 1] - d[m + 1]) ** 2 + (d[s + 2] - d[m + 2]) ** 2)
    return _clear_until(o[m], o[m + 1], o[m + 2], d[m], d[m + 1], d[m + 2], np.sqrt(spread), np.sqrt(widening), since, grid)


@numba.njit(cache=True, error_model="numpy")
def _tile(top, low, left, right, since, rays, grid):  # type: ignore[no-untyped-def]
    """The parameter up to which the rays of some rows and columns see nothing, at least `since`."""
    if rays.kind == FREE:
        return _tile_of_rays(top, low, left, right, since, rays, grid)
    if rays.kind == SIGHTS:
        return _tile_of_sights(top, low, left, right, since, rays, grid)
    return _tile_of_pinhole(rays.first + top + 0.5, rays.first + low - 0.5, left + 0.5, right - 0.5, since, rays, grid)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _ray(row, column, rays):  # type: ignore[no-untyped-def]
    """Origin, direction, and how far along the view axis a step along the ray leads."""
    p = 3 * (row * rays.width + column)
    if rays.kind == FREE:
        o, d = rays.starts, rays.alongs
        return o[p], o[p + 1], o[p + 2], d[p], d[p + 1], d[p + 2], 1.0
    if rays.kind == SIGHTS:
        dx, dy, dz = _turned(rays.turn, rays.sights[p], rays.sights[p + 1], rays.sights[p + 2])
        return rays.x, rays.y, rays.z, dx, dy, dz, np.float64(rays.sights[p + 2])
    dx, dy, dz, slant = _sight((column + 0.5) * rays.pitch, (rays.first + row + 0.5) * rays.pitch, rays)
    return rays.x, rays.y, rays.z, dx, dy, dz, slant


@numba.njit(cache=True, error_model="numpy")
def _seen(row, column, clear, shot, grid, view, pool, bench, seen, normal):  # type: ignore[no-untyped-def]
    """What one ray sees, which meets nothing until `clear`, into seen (9,), see `march`, but the depth is from the origin; and its normal into (3,)."""
    ox, oy, oz, dx, dy, dz, slant = _ray(row, column, shot)
    lx, ly, lz = np.float32(dx), np.float32(dy), np.float32(dz)
    if shot.looks:
        p = 3 * (row * shot.width + column)
        lx, ly, lz = shot.looking[p], shot.looking[p + 1], shot.looking[p + 2]
    t0, t1 = _entry(ox, oy, oz, dx, dy, dz, grid.nx * grid.brick, grid.ny * grid.brick, grid.nz * grid.brick)
    last = int(np.ceil((t1 - t0) / STEP - 0.5)) if t1 > t0 else 0
    begin = int(min(max((clear - t0) / STEP - 0.5, 0.0), last))
    ex, ey, ez = np.float32(ox + t0 * dx), np.float32(oy + t0 * dy), np.float32(oz + t0 * dz)
    ax, ay, az = np.float32(dx), np.float32(dy), np.float32(dz)
    march(ex, ey, ez, ax, ay, az, begin, last, grid, view, lx, ly, lz, pool, bench, seen)
    hit = seen[4]
    seen[4] = (t0 + hit) * slant
    if hit < np.inf:
        normal_into(ex + hit * ax, ey + hit * ay, ez + hit * az, grid, view, pool, normal)
    else:
        normal[0] = normal[1] = normal[2] = np.float32(0)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _side_of_runs(down, across, threads):  # type: ignore[no-untyped-def]
    """Tiles along the sides of the rectangles of them that threads take."""
    tiles = down * across // (threads * RUNS)
    tall = min(down, max(1, int(np.sqrt(tiles))))
    return tall, min(across, max(1, tiles // tall))


@numba.njit(cache=True, error_model="numpy")
def _draw_tile(top, low, left, right, rays, behind, grid, view, units, pool, bench, seen, face, colour, opacity, depth, normal, work):  # type: ignore[no-untyped-def]
    """The pixels of some rows and columns into the pictures of `trace`."""
    known = _tile(top, low, left, right, 0.0, rays, grid)
    parts = (right - left + PART - 1) // PART
    for part in range((low - top + PART - 1) // PART * parts):
        upper, first = top + part // parts * PART, left + part % parts * PART
        lower, last = min(upper + PART, low), min(first + PART, right)
        clear = _tile(upper, lower, first, last, known, rays, grid) if known < np.inf else known
        for row in range(upper, lower):
            for column in range(first, last):
                if clear == np.inf:
                    for m in range(9):
                        seen[m] = np.float32(0)
                    seen[4] = np.float32(np.inf)
                    face[0] = face[1] = face[2] = np.float32(0)
                else:
                    _seen(row, column, clear, rays, grid, view, pool, bench, seen, face)
                through = np.float32(1) - seen[3]
                for c in range(3):
                    colour[row, column, c] = seen[c] + through * behind[c]
                    if len(normal) > 0:
                        normal[row, column, c] = face[c]
                opacity[row, column], depth[row, column] = seen[3], seen[4] * units
                if len(work) > 0:
                    for m in range(4):
                        work[row, column, m] = seen[5 + m]


@numba.njit(cache=True, parallel=True, error_model="numpy")
def trace(shot, behind, packed, painted, brick, nearest, stretch, scale, degree, units, tile, threads, blocks, colour, opacity, depth, normal, work):  # type: ignore[no-untyped-def]
    """What rays in rows and columns see.

    behind    (3,) float32 colour to composite over
    packed    see `packed_tree`
    painted   (N + 1, 4) float32: see `cpu_blocks.paint`; not read where `nearest` is infinity
    nearest, stretch, scale, degree  see `cpu_blocks.View`
    units     world units per voxel
    tile      (rows, columns) of a tile
    blocks    in a thread's pool
    colour    (H, W, 3) float32
    opacity   (H, W) float32
    depth     (H, W) float32, world units: along the view axis for a camera and along the ray for rays as they come
    normal    (H, W, 3) float32, or (0, 0, 3) where none is wanted
    work      (H, W, 4) int32, or (0, 0, 4) where it is of no interest: cells looked at, samples tested, samples interpolated, colours looked up
    """
    # What is written to an array taken out of a tuple numba would think of no use, and leave out.
    height, width = opacity.shape
    down, across = (height + tile[0] - 1) // tile[0], (width + tile[1] - 1) // tile[1]
    # Each thread takes rectangles of tiles from all over the picture, for tiles of the sky cost next to nothing; neighbours meet the same bricks.
    tall, wide = _side_of_runs(down, across, threads)
    columns = (across + wide - 1) // wide
    runs = (down + tall - 1) // tall * columns
    bricks, size = len(packed.place), 4 * (brick + 2) ** 3
    slot, owner = np.full((threads, bricks), -1, np.int32), np.full((threads, blocks), -1, np.int32)
    kind, whole = np.zeros((threads, blocks), np.uint8), np.zeros((threads, 16), np.int64)
    values, voxels, room = np.empty((threads, (blocks + 1) * size), np.float32), np.empty((threads, size // 4), np.int32), np.zeros((threads, 256), np.float32)
    words = values.view(np.int32)
    for worker in numba.prange(threads):
        values[worker, blocks * size :] = 0
        whole[worker, 8 : 8 + QUEUE] = blocks * size
        pool = Pool(
            size,
            blocks,
            pointer(slot[worker]),
            pointer(owner[worker]),
            pointer(kind[worker]),
            pointer(whole[worker, :8]),
            pointer(values[worker]),
            pointer(words[worker]),
            pointer(painted),
            len(painted) - 1,
            pointer(voxels[worker]),
            pointer(whole[worker, 8:]),
        )
        bench = Bench(
            pointer(room[worker, 32:48]),
            pointer(room[worker, 48:64]),
            pointer(room[worker, 64:80]),
            pointer(room[worker, 80:96]),
            pointer(room[worker, 96:128]),
            pointer(room[worker, 128:160]),
        )
        grid, rays, view = grid_of(packed, brick), rays_of(shot), View(pointer(shot.toward), stretch, nearest, scale, degree)
        seen, face = pointer(room[worker, 160:192]), pointer(room[worker, 192:])
        for run in range(runs):
            # Neighbouring runs, along rows and columns, go to different threads.
            if (run // columns + run % columns) % threads != worker:
                continue
            for n in range(tall * wide):
                row, column = run // columns * tall + n // wide, run % columns * wide + n % wide
                if row < down and column < across:
                    top, left = row * tile[0], column * tile[1]
                    _draw_tile(
                        top, min(top + tile[0], height), left, min(left + tile[1], width), rays, behind, grid, view, units, pool, bench, seen, face,
                        colour, opacity, depth, normal, work,
                    )  # fmt: skip


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
