"""Rays on the CPU (numba, all cores): into normalised device coordinates and hits back into the world, and directions of pixels.

The reference of the first, and the meaning of the letters, is `efficientnerf.geometry.ndc`; here each ray is warped in one pass. R rays.
"""

from __future__ import annotations

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.geometry.ndc import BEYOND, Ndc, NdcRays

BLOCK = 4096  # rays per task


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _warp_rays(origins, directions, rotation, position, a, b, near, beyond, start, along, begin, ds_dt, dlogz_dt):  # type: ignore[no-untyped-def]
    for block in numba.prange((len(origins) + BLOCK - 1) // BLOCK):
        for n in range(block * BLOCK, min(len(origins), block * BLOCK + BLOCK)):
            px, py, pz = origins[n, 0] - position[0], origins[n, 1] - position[1], origins[n, 2] - position[2]
            vx, vy, vz = directions[n, 0], directions[n, 1], directions[n, 2]
            x, y = px * rotation[0, 0] + py * rotation[1, 0] + pz * rotation[2, 0], px * rotation[0, 1] + py * rotation[1, 1] + pz * rotation[2, 1]
            z = px * rotation[0, 2] + py * rotation[1, 2] + pz * rotation[2, 2]
            dx, dy = vx * rotation[0, 0] + vy * rotation[1, 0] + vz * rotation[2, 0], vx * rotation[0, 1] + vy * rotation[1, 1] + vz * rotation[2, 1]
            dz = vx * rotation[0, 2] + vy * rotation[1, 2] + vz * rotation[2, 2]
            reaches, t = True, 0.0
            if z < near:
                reaches = dz > 1e-9
                t = (near - z) / dz if reaches else 0.0
            x, y, z = x + t * dx, y + t * dy, max(z + t * dz, near) if reaches else near
            jx, jy, jz = a * (dx * z - x * dz) / (z * z), b * (dy * z - y * dz) / (z * z), 2 * near * dz / (z * z)
            g = np.sqrt(jx * jx + jy * jy + jz * jz)
            begin[n], dlogz_dt[n] = t, dz / z
            if not reaches or g < 1e-12:
                start[n, 0], start[n, 1], start[n, 2] = 0.0, 0.0, beyond
                along[n, 0], along[n, 1], along[n, 2] = 0.0, 0.0, 1.0
                ds_dt[n] = 1.0
                continue
            start[n, 0], start[n, 1], start[n, 2] = a * x / z, b * y / z, 1 - 2 * near / z
            along[n, 0], along[n, 1], along[n, 2] = jx / g, jy / g, jz / g
            ds_dt[n] = g


def warp_rays(ndc: Ndc, origins: np.ndarray, directions: np.ndarray) -> NdcRays:
    """`Ndc.rays` on float64 arrays."""
    count = len(origins)
    start, along = np.empty((count, 3)), np.empty((count, 3))
    begin, ds_dt, dlogz_dt = np.empty(count), np.empty(count), np.empty(count)
    pose = np.ascontiguousarray(ndc.world_from_camera, np.float64)
    given = (np.ascontiguousarray(part, np.float64) for part in (origins, directions, pose[:3, :3], pose[:3, 3]))
    _warp_rays(*given, *ndc.slopes, ndc.near, BEYOND, start, along, begin, ds_dt, dlogz_dt)
    return NdcRays(start, along, begin, ds_dt, dlogz_dt)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _unwarp_hits(start, along, begin, ds_dt, dlogz_dt, distance, normal, rotation, a, b, near, out_distance, out_normal):  # type: ignore[no-untyped-def]
    for block in numba.prange((len(start) + BLOCK - 1) // BLOCK):
        for n in range(block * BLOCK, min(len(start), block * BLOCK + BLOCK)):
            s = np.float64(distance[n])
            out_distance[n] = np.inf
            out_normal[n, 0] = out_normal[n, 1] = out_normal[n, 2] = 0
            if not np.isfinite(s):
                continue
            remaining = ds_dt[n] - dlogz_dt[n] * s
            if remaining > 1e-6 * ds_dt[n]:
                out_distance[n] = begin[n] + s / remaining
            z = 2 * near / max(1 - (start[n, 2] + s * along[n, 2]), 1e-9)
            x, y = (start[n, 0] + s * along[n, 0]) * z / a, (start[n, 1] + s * along[n, 1]) * z / b
            nx, ny, nz = a * normal[n, 0], b * normal[n, 1], 2 * near * np.float64(normal[n, 2])
            nz = (nz - x * nx - y * ny) / z
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            if length > 0:
                for k in range(3):
                    out_normal[n, k] = (rotation[k, 0] * nx + rotation[k, 1] * ny + rotation[k, 2] * nz) / length


def unwarp_hits(ndc: Ndc, warped: NdcRays, distance: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World distances (R,) float32 (`world_distance`) and world normals (R, 3) float32 (`Ndc.world_normals`) of hits on warped rays.

    distance  (R,)   float32 along the warped rays; inf where nothing is hit
    normal    (R, 3) float32 in normalised device coordinates
    """
    out = np.empty(len(distance), np.float32), np.empty((len(distance), 3), np.float32)
    rotation = np.ascontiguousarray(ndc.world_from_camera[:3, :3], np.float64)
    _unwarp_hits(*warped, np.ascontiguousarray(distance), np.ascontiguousarray(normal), rotation, *ndc.slopes, ndc.near, *out)
    return out


@numba.njit(cache=True, parallel=True, error_model="numpy")
def ray_directions(lookup, begin, knots, stride, pixel, width, rotation, view, out):  # type: ignore[no-untyped-def]
    """World directions of pixels of several views into out (N, 3): rotation[view] of a direction interpolated in the view's lens table.

    lookup               (., 3) camera-frame directions at knots `stride` pixels apart, the tables of all lenses end to end
    begin, knots, width  of each view: start of its table, knots per row, and pixels per row
    pixel, view          (N,) row-major pixel and its view
    rotation             (V, 3, 3) world from camera
    """
    one = np.float32(1)
    for n in numba.prange(len(view)):
        v = view[n]
        row, column = pixel[n] // width[v], pixel[n] % width[v]
        at = begin[v] + row // stride * knots[v] + column // stride
        x, y, z = lookup[at, 0], lookup[at, 1], lookup[at, 2]
        if stride > 1:
            f, g = np.float32(column % stride) / np.float32(stride), np.float32(row % stride) / np.float32(stride)
            right, below = at + (1 if f > 0 else 0), knots[v] if g > 0 else 0
            a, b, c, d = (one - g) * (one - f), (one - g) * f, g * (one - f), g * f
            x = a * x + b * lookup[right, 0] + c * lookup[at + below, 0] + d * lookup[right + below, 0]
            y = a * y + b * lookup[right, 1] + c * lookup[at + below, 1] + d * lookup[right + below, 1]
            z = a * z + b * lookup[right, 2] + c * lookup[at + below, 2] + d * lookup[right + below, 2]
            length = np.sqrt(x * x + y * y + z * z)
            x, y, z = x / length, y / length, z / length
        for axis in range(3):
            out[n, axis] = rotation[v, axis, 0] * x + rotation[v, axis, 1] * y + rotation[v, axis, 2] * z
