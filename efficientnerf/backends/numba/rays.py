"""Rays on the CPU (numba, all cores): into normalised device coordinates and hits back into the world, those of pixels, and harmonics of directions.

The reference of the first, and the meaning of the letters, is `efficientnerf.geometry.ndc`; here each ray is warped in one pass. R rays.
"""

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.torch.rays import LEAST_SLANT
from efficientnerf.geometry.ndc import BEYOND, Ndc, NdcRays
from efficientnerf.rendering import harmonics

BLOCK, BASIS_BLOCK = 4096, 512  # rays per task
_FACTORS = np.array([harmonics.C0, -harmonics.C1, harmonics.C1, -harmonics.C1, *harmonics.C2, *harmonics.C3, *harmonics.C4], np.float32)


def ndc_numbers(ndc: Ndc) -> np.ndarray:
    """A reference camera for kernels, (15,) float64: its rotation row by row, its position, slopes a and b, and the near plane."""
    return np.concatenate([np.ravel(ndc.world_from_camera[:3, :3]), ndc.world_from_camera[:3, 3], ndc.slopes, [ndc.near]]).astype(np.float64)


@numba.njit(cache=True, inline="always", error_model="numpy")
def warp_ray(x, y, z, dx, dy, dz, ndc):
    """`Ndc.rays` of a ray from (x, y, z) along (dx, dy, dz): origin and direction, and the way back, begin, ds_dt and dlogz_dt; `ndc` see `ndc_numbers`."""
    a, b, near = ndc[12], ndc[13], ndc[14]
    x, y, z = x - ndc[9], y - ndc[10], z - ndc[11]
    x, y, z = x * ndc[0] + y * ndc[3] + z * ndc[6], x * ndc[1] + y * ndc[4] + z * ndc[7], x * ndc[2] + y * ndc[5] + z * ndc[8]
    dx, dy, dz = dx * ndc[0] + dy * ndc[3] + dz * ndc[6], dx * ndc[1] + dy * ndc[4] + dz * ndc[7], dx * ndc[2] + dy * ndc[5] + dz * ndc[8]
    reaches, t = True, 0.0
    if z < near:
        reaches = dz > 1e-9
        t = (near - z) / dz if reaches else 0.0
    x, y, z = x + t * dx, y + t * dy, max(z + t * dz, near) if reaches else near
    inverse = 1 / z
    jx, jy, jz = a * (dx - x * dz * inverse) * inverse, b * (dy - y * dz * inverse) * inverse, 2 * near * dz * inverse * inverse
    g = np.sqrt(jx * jx + jy * jy + jz * jz)
    if not reaches or g < 1e-12:
        return 0.0, 0.0, BEYOND, 0.0, 0.0, 1.0, t, 1.0, dz * inverse
    shorter = 1 / g
    return a * x * inverse, b * y * inverse, 1 - 2 * near * inverse, jx * shorter, jy * shorter, jz * shorter, t, g, dz * inverse


@numba.njit(cache=True, inline="always", error_model="numpy")
def world_distance(along, begin, ds_dt, dlogz_dt):
    """`efficientnerf.geometry.ndc.world_distance` of one point, float32."""
    rest = ds_dt - dlogz_dt * along
    return np.float32(begin + along / rest) if rest > 1e-6 * ds_dt else np.float32(np.inf)


@numba.njit(cache=True, inline="always", error_model="numpy")
def world_normal(x, y, z, nx, ny, nz, ndc):
    """`Ndc.world_normals` of one normal at a point, float32."""
    depth = 2 * ndc[14] / max(1 - z, 1e-9)
    x, y = x * depth / ndc[12], y * depth / ndc[13]
    nx, ny, nz = ndc[12] * nx, ndc[13] * ny, 2 * ndc[14] * nz
    nz = (nz - x * nx - y * ny) / depth
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    scale = 1 / length if length > 0 else 0.0
    return (
        np.float32((ndc[0] * nx + ndc[1] * ny + ndc[2] * nz) * scale), np.float32((ndc[3] * nx + ndc[4] * ny + ndc[5] * nz) * scale),
        np.float32((ndc[6] * nx + ndc[7] * ny + ndc[8] * nz) * scale),
    )  # fmt: skip


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _warp_rays(origins, directions, ndc, start, along, begin, ds_dt, dlogz_dt):
    for block in numba.prange((len(origins) + BLOCK - 1) // BLOCK):
        for n in range(block * BLOCK, min(len(origins), block * BLOCK + BLOCK)):
            x, y, z, dx, dy, dz, begin[n], ds_dt[n], dlogz_dt[n] = warp_ray(
                origins[n, 0], origins[n, 1], origins[n, 2], directions[n, 0], directions[n, 1], directions[n, 2], ndc
            )
            start[n, 0], start[n, 1], start[n, 2], along[n, 0], along[n, 1], along[n, 2] = x, y, z, dx, dy, dz


def warp_rays(ndc: Ndc, origins: np.ndarray, directions: np.ndarray) -> NdcRays:
    """`Ndc.rays` on float64 arrays."""
    count = len(origins)
    start, along = np.empty((count, 3)), np.empty((count, 3))
    begin, ds_dt, dlogz_dt = np.empty(count), np.empty(count), np.empty(count)
    given = (np.ascontiguousarray(part, np.float64) for part in (origins, directions))
    _warp_rays(*given, ndc_numbers(ndc), start, along, begin, ds_dt, dlogz_dt)
    return NdcRays(start, along, begin, ds_dt, dlogz_dt)


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def _unwarp_hits(start, along, begin, ds_dt, dlogz_dt, distance, normal, ndc, out_distance, out_normal):
    for block in numba.prange((len(start) + BLOCK - 1) // BLOCK):
        for n in range(block * BLOCK, min(len(start), block * BLOCK + BLOCK)):
            s = np.float64(distance[n])
            out_distance[n] = np.inf
            out_normal[n, 0] = out_normal[n, 1] = out_normal[n, 2] = 0
            if not np.isfinite(s):
                continue
            out_distance[n] = world_distance(s, begin[n], ds_dt[n], dlogz_dt[n])
            x, y, z = start[n, 0] + s * along[n, 0], start[n, 1] + s * along[n, 1], start[n, 2] + s * along[n, 2]
            nx, ny, nz = np.float64(normal[n, 0]), np.float64(normal[n, 1]), np.float64(normal[n, 2])
            out_normal[n, 0], out_normal[n, 1], out_normal[n, 2] = world_normal(x, y, z, nx, ny, nz, ndc)


def unwarp_hits(ndc: Ndc, warped: NdcRays, distance: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World distances (R,) float32 (`world_distance`) and world normals (R, 3) float32 (`Ndc.world_normals`) of hits on warped rays.

    distance  (R,)   float32 along the warped rays; inf where nothing is hit
    normal    (R, 3) float32 in normalised device coordinates
    """
    out = np.empty(len(distance), np.float32), np.empty((len(distance), 3), np.float32)
    _unwarp_hits(*warped, np.ascontiguousarray(distance), np.ascontiguousarray(normal), ndc_numbers(ndc), *out)
    return out


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def pixel_rays(tables, stride, index, origins, directions, near, far):
    """`efficientnerf.backends.torch.rays.pixel_rays` into origins and directions (R, 3), near and far (R,)."""
    lookup, lens, knots, offsets, width, rotation, centre, all_near, all_far = tables
    one = np.float32(1)
    for n in numba.prange(len(index)):
        v, last = 0, len(offsets) - 1  # the view whose pixels these are
        while last - v > 1:
            middle = (v + last) // 2
            if offsets[middle] <= index[n]:
                v = middle
            else:
                last = middle
        pixel = index[n] - offsets[v]
        row, column = pixel // width[v], pixel % width[v]
        at = lens[v] + row // stride * knots[v] + column // stride
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
        slant = np.float32(0)
        for axis in range(3):
            along = rotation[v, axis, 0] * x + rotation[v, axis, 1] * y + rotation[v, axis, 2] * z
            origins[n, axis], directions[n, axis] = centre[v, axis], along
            slant += along * rotation[v, axis, 2]
        slant = max(slant, np.float32(LEAST_SLANT))
        near[n], far[n] = all_near[v] / slant, all_far[v] / slant


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def basis(directions, degree, out):
    """`efficientnerf.rendering.harmonics.basis` of unit directions (R, 3) into out (R, K); products in its order, so that both give the same bytes."""
    one, two, three, four, seven = np.float32(1), np.float32(2), np.float32(3), np.float32(4), np.float32(7)
    c = _FACTORS
    for block in numba.prange((len(directions) + BASIS_BLOCK - 1) // BASIS_BLOCK):
        for r in range(block * BASIS_BLOCK, min(len(directions), (block + 1) * BASIS_BLOCK)):
            x, y, z = directions[r, 0], directions[r, 1], directions[r, 2]
            xx, yy, zz = x * x, y * y, z * z
            out[r, 0] = c[0]
            if degree > 0:
                out[r, 1], out[r, 2], out[r, 3] = c[1] * y, c[2] * z, c[3] * x
            if degree > 1:
                out[r, 4], out[r, 5], out[r, 6] = c[4] * x * y, c[5] * y * z, c[6] * (two * zz - xx - yy)
                out[r, 7], out[r, 8] = c[7] * x * z, c[8] * (xx - yy)
            if degree > 2:
                out[r, 9], out[r, 10], out[r, 11] = c[9] * y * (three * xx - yy), c[10] * x * y * z, c[11] * y * (four * zz - xx - yy)
                out[r, 12], out[r, 13] = c[12] * z * (two * zz - three * xx - three * yy), c[13] * x * (four * zz - xx - yy)
                out[r, 14], out[r, 15] = c[14] * z * (xx - yy), c[15] * x * (xx - three * yy)
            if degree > 3:
                out[r, 16], out[r, 17] = c[16] * x * y * (xx - yy), c[17] * y * z * (three * xx - yy)
                out[r, 18], out[r, 19] = c[18] * x * y * (seven * zz - one), c[19] * y * z * (seven * zz - three)
                out[r, 20] = c[20] * (zz * (np.float32(35) * zz - np.float32(30)) + three)
                out[r, 21], out[r, 22] = c[21] * x * z * (seven * zz - three), c[22] * (xx - yy) * (seven * zz - one)
                out[r, 23], out[r, 24] = c[23] * x * z * (xx - three * yy), c[24] * (xx * (xx - three * yy) - yy * (three * xx - yy))
