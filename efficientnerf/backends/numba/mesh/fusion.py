"""Depth images to planes, and planes of many views to a signed distance (numba).

C cameras, H x W pixels, N voxels. A plane that a camera sees has an inverse depth that is linear in pixels: 1 / z = w + a du + b dv around a pixel.
"""

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.backends.numba.tasks import interleaved

W, A, B, LENGTH, CONFIDENCE, NEAREST = 0, 1, 2, 3, 4, 5  # channels of a pixel
CHANNELS = 6
FAINT, OPAQUE, SURE = 0.25, 0.5, 0.75  # opacities: below the first a pixel is seen through, from the last on its depth is sure
FILLED = 2
DEEPEST, ENOUGH = 6.0, 1.0  # truncations behind surfaces, up to which a voxel is solid that so many views agree on and hardly any contradicts
STEEPEST = 0.15  # cosine between a surface's normal and a ray, below which the ray says nothing of the surface


@numba.njit(cache=True, inline="always", error_model="numpy")
def _slope(before, here, after):  # type: ignore[no-untyped-def]
    """The gentler of two one-sided differences; values of zero are none."""
    left, right = here - before, after - here
    if before <= 0.0:
        return right if after > 0.0 else 0.0
    if after <= 0.0 or abs(left) < abs(right):
        return left
    return right


@numba.njit(cache=True, inline="always", error_model="numpy")
def _inverse(depth, opacity, y, x):  # type: ignore[no-untyped-def]
    """Inverse depth of a pixel; zero outside of the image and where it is not opaque."""
    if y < 0 or x < 0 or y >= depth.shape[0] or x >= depth.shape[1] or not (opacity[y, x] >= OPAQUE and depth[y, x] > 0.0 and np.isfinite(depth[y, x])):
        return 0.0
    return 1.0 / np.float64(depth[y, x])


@numba.njit(cache=True, error_model="numpy")
def _plane(depth, opacity, y, x, radius, band, even):  # type: ignore[no-untyped-def]
    """The plane through a pixel and those around it that lie within `band` of it, by weighted least squares: w, a, b, confidence."""
    w = _inverse(depth, opacity, y, x)
    a = _slope(_inverse(depth, opacity, y, x - 1), w, _inverse(depth, opacity, y, x + 1))
    b = _slope(_inverse(depth, opacity, y - 1, x), w, _inverse(depth, opacity, y + 1, x))
    allowed = band if even else band * w * w
    n = su = sv = suu = suv = svv = sw = suw = svw = sww = whole = 0.0
    for dv in range(-radius, radius + 1):
        for du in range(-radius, radius + 1):
            share = 1.0 / (1.0 + (du * du + dv * dv) / (0.5 * radius * radius))
            whole += share
            other = _inverse(depth, opacity, y + dv, x + du)
            beside = other - w
            if other > 0.0 and abs(beside - a * du - b * dv) <= allowed:
                n, su, sv, sw = n + share, su + share * du, sv + share * dv, sw + share * beside
                suu, suv, svv = suu + share * du * du, suv + share * du * dv, svv + share * dv * dv
                suw, svw, sww = suw + share * du * beside, svw + share * dv * beside, sww + share * beside * beside
    full = n / whole
    suu, suv, svv, suw, svw, sww = suu - su * su / n, suv - su * sv / n, svv - sv * sv / n, suw - su * sw / n, svw - sv * sw / n, sww - sw * sw / n
    determinant = suu * svv - suv * suv
    if not determinant > 0.05 * n * n or full < 0.25:
        return w, a, b, 0.25 * full
    a, b = (suw * svv - svw * suv) / determinant, (svw * suu - suw * suv) / determinant
    error = max(0.0, sww - a * suw - b * svw) / n / (allowed * allowed)
    return w + (sw - a * su - b * sv) / n, a, b, full / (1.0 + 16.0 * error)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def fit_planes(depth, opacity, lens, begin, end, radius, band, even, out):  # type: ignore[no-untyped-def]
    """What each pixel of the rows `begin` to `end` of an image sees.

    depth, opacity  (H, W) float32, along the view axis
    lens            (4,) float64 fx, fy, cx, cy
    radius, band    pixels around, and how far off its plane a pixel may be to count: in units of the depth or, where `even`, of the inverse depth
    out             (H, W, CHANNELS) float32: w, a, b; length of the plane's normal in the camera's frame; confidence, 0 to 1, zero where there is no surface;
                    greatest inverse depth of the pixel and its neighbours, zero where all of them are seen through, infinite where one neither is nor is opaque
    """
    height, width = depth.shape
    for task in numba.prange(end - begin):
        y = begin + interleaved(task, end - begin)
        for x in range(width):
            nearest = 0.0
            for v in range(max(0, y - 1), min(height, y + 2)):
                for u in range(max(0, x - 1), min(width, x + 2)):
                    here = _inverse(depth, opacity, v, u)
                    if here <= 0.0 and not opacity[v, u] < FAINT:
                        here = np.inf
                    nearest = max(nearest, here)
            out[y, x, NEAREST] = nearest
            out[y, x, CONFIDENCE] = 0.0
            if _inverse(depth, opacity, y, x) > 0.0:
                w, a, b, confidence = _plane(depth, opacity, y, x, radius, band, even)
                middle = w + a * (lens[2] - x - 0.5) + b * (lens[3] - y - 0.5)
                out[y, x, W], out[y, x, A], out[y, x, B] = w, a, b
                out[y, x, LENGTH] = np.sqrt((a * lens[0]) ** 2 + (b * lens[1]) ** 2 + middle * middle)
                out[y, x, CONFIDENCE] = confidence * min(1.0, max(0.1, (opacity[y, x] - OPAQUE) / (SURE - OPAQUE)))


@numba.njit(cache=True, inline="always", error_model="numpy")
def _slope_of_plane(pixel, column, row, m, w, lens):  # type: ignore[no-untyped-def]
    """How fast n . x - 1 of a pixel's plane grows along its normal in the grid's frame, at a point with this W."""
    if m[3, 2] == 0.0:  # the world
        return pixel[LENGTH]
    n0, n1 = pixel[A] * lens[0], pixel[B] * lens[1]
    n2 = pixel[W] + pixel[A] * (lens[2] - column - 0.5) + pixel[B] * (lens[3] - row - 0.5)
    # A plane of the world is one of the frame: W (n . x - 1) is linear in it.
    q0, q1 = n0 * m[0, 0] + n1 * m[1, 0] + n2 * m[2, 0] - m[3, 0], n0 * m[0, 1] + n1 * m[1, 1] + n2 * m[2, 1] - m[3, 1]
    q2 = n0 * m[0, 2] + n1 * m[1, 2] + n2 * m[2, 2] - m[3, 2]
    return np.sqrt(q0 * q0 + q1 * q1 + q2 * q2) / w


@numba.njit(cache=True, parallel=True, error_model="numpy")
def fuse(first, low, voxel, depth_scale, wanted, planes, cameras, lenses, truncation, distance, weight):  # type: ignore[no-untyped-def]
    """Signed distance of voxels from the surface that views see, positive before it.

    first       (3,) float64 the corner of the grid, in its frame; low (3,) int64 index of the first voxel
    depth_scale a voxel is voxel * depth_scale / W^2 deep in the world, for the W below
    wanted      (X, Y, Z) uint8 which voxels are asked for: 0 not, FILLED those that are solid where views agree that they lie behind surfaces
    planes      (C, H, W, CHANNELS) of `fit_planes`
    cameras     (C, 4, 4) float64 takes (x, y, z, 1) of the frame to W times (x, y, z, 1) of the camera: W is 1 in the world, see `Ndc.world_from_ndc`
    lenses      (C, 4) float64
    truncation  of distances, voxels
    distance    (X, Y, Z) float32 mean of the views, voxels, from -truncation to truncation
    weight      (X, Y, Z) float32 sum of the views' confidences; zero where none sees it
    """
    height, width = planes.shape[1], planes.shape[2]
    rows = wanted.shape[1]
    for task in numba.prange(wanted.shape[0] * rows):
        i, j = divmod(interleaved(task, wanted.shape[0] * rows), rows)
        for k in range(wanted.shape[2]):
            if wanted[i, j, k] == 0:
                continue
            px, py, pz = first[0] + (low[0] + i + 0.5) * voxel, first[1] + (low[1] + j + 0.5) * voxel, first[2] + (low[2] + k + 0.5) * voxel
            total = sums = behind = 0.0
            for c in range(len(cameras)):
                m = cameras[c]
                w = m[3, 0] * px + m[3, 1] * py + m[3, 2] * pz + m[3, 3]
                z = (m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]) / w
                if not (w > 0.0 and z > 1e-6):
                    continue
                x, y = (m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3]) / w, (m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3]) / w
                u, v = lenses[c, 0] * x / z + lenses[c, 2], lenses[c, 1] * y / z + lenses[c, 3]
                if not (u >= 0.0 and v >= 0.0 and u < width and v < height):
                    continue
                column, row = int(u), int(v)
                pixel = planes[c, row, column]
                if pixel[NEAREST] == 0.0 or 1.0 / pixel[NEAREST] - z > truncation * voxel * depth_scale / (w * w):
                    total, sums = total + 1.0, sums + truncation
                    continue
                if pixel[CONFIDENCE] <= 0.0:
                    continue
                across = z * (pixel[W] + pixel[A] * (u - column - 0.5) + pixel[B] * (v - row - 0.5))
                cosine = across / (pixel[LENGTH] * np.sqrt(x * x + y * y + z * z))
                if cosine < STEEPEST:
                    continue
                s = (1.0 - across) / (_slope_of_plane(pixel, column, row, m, w, lenses[c]) * voxel)
                if s <= -truncation:
                    behind += pixel[CONFIDENCE] if s > -DEEPEST * truncation else 0.0
                elif s <= truncation:
                    share = pixel[CONFIDENCE] * cosine * (1.0 if s >= 0.0 else 1.0 + s / truncation)
                    total, sums = total + share, sums + share * s
            if wanted[i, j, k] == FILLED and behind > ENOUGH and total < 0.1 * behind:
                total, sums = total + behind, sums - truncation * behind
            if total > 0.0:
                distance[i, j, k], weight[i, j, k] = sums / total, total
