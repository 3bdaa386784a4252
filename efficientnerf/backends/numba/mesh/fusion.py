"""Depth images to planes, and planes of many views to a signed distance (numba).

C cameras, H x W pixels, N voxels. A plane that a camera sees has an inverse depth that is linear in pixels: 1 / z = w + a du + b dv around a pixel.
"""

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.tasks import interleaved

W, A, B, LENGTH, CONFIDENCE, NEAREST = 0, 1, 2, 3, 4, 5  # channels of a pixel
CHANNELS = 6
FAINT, OPAQUE, SURE = 0.25, 0.5, 0.75  # opacities: below the first a pixel is seen through, from the last on its depth is sure
FILLED = 2
DEEPEST, ENOUGH = 6.0, 1.0  # truncations behind surfaces, up to which a voxel is solid that so many views agree on and hardly any contradicts
STEEPEST = 0.15  # cosine between a surface's normal and a ray, below which the ray says nothing of the surface


@numba.njit(cache=True, inline="always", error_model="numpy")
def _slope(before, here, after):
    """The gentler of two one-sided differences; values of zero are none."""
    left, right = here - before, after - here
    if before <= 0.0:
        return right if after > 0.0 else 0.0
    if after <= 0.0 or abs(left) < abs(right):
        return left
    return right


@numba.njit(cache=True, error_model="numpy")
def _inverses(depth, opacity, begin, end, radius):
    """Inverse depths (end - begin + 2 radius, W + 2 radius) float64 of rows of an image and what is around them; zero outside of the image and where a pixel
    is not opaque."""
    height, width = depth.shape
    out = np.zeros((end - begin + 2 * radius, width + 2 * radius))
    for y in range(max(0, begin - radius), min(height, end + radius)):
        for x in range(width):
            if opacity[y, x] >= OPAQUE and depth[y, x] > 0.0 and np.isfinite(depth[y, x]):
                out[y - begin + radius, x + radius] = 1.0 / np.float64(depth[y, x])
    return out


@numba.njit(cache=True, error_model="numpy")
def _shares(radius):
    """What pixels around one count (2 radius + 1, 2 radius + 1), and the sum of that."""
    out, whole = np.empty((2 * radius + 1, 2 * radius + 1)), 0.0
    for dv in range(-radius, radius + 1):
        for du in range(-radius, radius + 1):
            share = 1.0 / (1.0 + (du * du + dv * dv) / (0.5 * radius * radius))
            out[dv + radius, du + radius] = share
            whole += share
    return out, whole


@numba.njit(cache=True, error_model="numpy")
def _plane(inverse, y, x, shares, whole, radius, band, even):
    """The plane through a pixel and those around it that lie within `band` of it, by weighted least squares: w, a, b, confidence."""
    w = inverse[y, x]
    a = _slope(inverse[y, x - 1], w, inverse[y, x + 1])
    b = _slope(inverse[y - 1, x], w, inverse[y + 1, x])
    allowed = band if even else band * w * w
    n = su = sv = suu = suv = svv = sw = suw = svw = sww = 0.0
    for dv in range(-radius, radius + 1):
        for du in range(-radius, radius + 1):
            share, other = shares[dv + radius, du + radius], inverse[y + dv, x + du]
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


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def fit_planes(depth, opacity, lens, begin, end, radius, band, even, out):
    """What each pixel of the rows `begin` to `end` of an image sees.

    depth, opacity  (H, W) float32, along the view axis
    lens            (4,) float64 fx, fy, cx, cy
    radius, band    pixels around, and how far off its plane a pixel may be to count: in units of the depth or, where `even`, of the inverse depth
    out             (H, W, CHANNELS) float32: w, a, b; length of the plane's normal in the camera's frame; confidence, 0 to 1, zero where there is no surface;
                    greatest inverse depth of the pixel and its neighbours, zero where all of them are seen through, infinite where one neither is nor is opaque
    """
    height, width = depth.shape
    inverse = _inverses(depth, opacity, begin, end, radius)
    shares, whole = _shares(radius)
    for task in numba.prange(end - begin):
        y = begin + interleaved(task, end - begin)
        row = y - begin + radius  # of `inverse`
        for x in range(width):
            nearest = 0.0
            for v in range(max(0, y - 1), min(height, y + 2)):
                for u in range(max(0, x - 1), min(width, x + 2)):
                    here = inverse[row + v - y, u + radius]
                    if here <= 0.0 and not opacity[v, u] < FAINT:
                        here = np.inf
                    nearest = max(nearest, here)
            out[y, x, NEAREST] = nearest
            out[y, x, CONFIDENCE] = 0.0
            if inverse[row, x + radius] > 0.0:
                w, a, b, confidence = _plane(inverse, row, x + radius, shares, whole, radius, band, even)
                middle = w + a * (lens[2] - x - 0.5) + b * (lens[3] - y - 0.5)
                out[y, x, W], out[y, x, A], out[y, x, B] = w, a, b
                out[y, x, LENGTH] = np.sqrt((a * lens[0]) ** 2 + (b * lens[1]) ** 2 + middle * middle)
                out[y, x, CONFIDENCE] = confidence * min(1.0, max(0.1, (opacity[y, x] - OPAQUE) / (SURE - OPAQUE)))


@numba.njit(cache=True, inline="always", error_model="numpy")
def _slope_of_plane(pixel, column, row, m, w, lens):
    """How fast n . x - 1 of a pixel's plane grows along its normal in the grid's frame, at a point with this W."""
    if m[3, 2] == 0.0:  # the world
        return pixel[LENGTH]
    n0, n1 = pixel[A] * lens[0], pixel[B] * lens[1]
    n2 = pixel[W] + pixel[A] * (lens[2] - column - 0.5) + pixel[B] * (lens[3] - row - 0.5)
    # A plane of the world is one of the frame: W (n . x - 1) is linear in it.
    q0, q1 = n0 * m[0, 0] + n1 * m[1, 0] + n2 * m[2, 0] - m[3, 0], n0 * m[0, 1] + n1 * m[1, 1] + n2 * m[2, 1] - m[3, 1]
    q2 = n0 * m[0, 2] + n1 * m[1, 2] + n2 * m[2, 2] - m[3, 2]
    return np.sqrt(q0 * q0 + q1 * q1 + q2 * q2) / w


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def fuse(first, low, voxel, depth_scale, wanted, planes, cameras, lenses, truncation, distance, weight):
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
    rows, depth = wanted.shape[1], wanted.shape[2]
    for task in numba.prange(wanted.shape[0] * rows):
        i, j = divmod(interleaved(task, wanted.shape[0] * rows), rows)
        asked = np.flatnonzero(wanted[i, j])
        if len(asked) == 0:
            continue
        px, py = first[0] + (low[0] + i + 0.5) * voxel, first[1] + (low[1] + j + 0.5) * voxel
        total, sums, behind = np.zeros(depth), np.zeros(depth), np.zeros(depth)
        for c in range(len(cameras)):
            m, lens = cameras[c], lenses[c]
            x0, y0 = m[0, 0] * px + m[0, 1] * py, m[1, 0] * px + m[1, 1] * py
            z0, w0 = m[2, 0] * px + m[2, 1] * py, m[3, 0] * px + m[3, 1] * py
            for k in asked:
                pz = first[2] + (low[2] + k + 0.5) * voxel
                w = w0 + m[3, 2] * pz + m[3, 3]
                x, y, z = x0 + m[0, 2] * pz + m[0, 3], y0 + m[1, 2] * pz + m[1, 3], z0 + m[2, 2] * pz + m[2, 3]
                least = truncation * voxel * depth_scale
                if w != 1.0:  # not in the world
                    x, y, z, least = x / w, y / w, z / w, least / (w * w)
                if not (w > 0.0 and z > 1e-6):
                    continue
                u, v = lens[0] * x / z + lens[2], lens[1] * y / z + lens[3]
                if not (u >= 0.0 and v >= 0.0 and u < width and v < height):
                    continue
                column, row = int(u), int(v)
                pixel = planes[c, row, column]
                if pixel[NEAREST] == 0.0 or 1.0 / pixel[NEAREST] - z > least:
                    total[k], sums[k] = total[k] + 1.0, sums[k] + truncation
                    continue
                if pixel[CONFIDENCE] <= 0.0:
                    continue
                across = z * (pixel[W] + pixel[A] * (u - column - 0.5) + pixel[B] * (v - row - 0.5))
                cosine = across / (pixel[LENGTH] * np.sqrt(x * x + y * y + z * z))
                if cosine < STEEPEST:
                    continue
                s = (1.0 - across) / (_slope_of_plane(pixel, column, row, m, w, lens) * voxel)
                if s <= -truncation:
                    behind[k] += pixel[CONFIDENCE] if s > -DEEPEST * truncation else 0.0
                elif s <= truncation:
                    share = pixel[CONFIDENCE] * cosine * (1.0 if s >= 0.0 else 1.0 + s / truncation)
                    total[k], sums[k] = total[k] + share, sums[k] + share * s
        for k in asked:
            if wanted[i, j, k] == FILLED and behind[k] > ENOUGH and total[k] < 0.1 * behind[k]:
                total[k], sums[k] = total[k] + behind[k], sums[k] - truncation * behind[k]
            if total[k] > 0.0:
                distance[i, j, k], weight[i, j, k] = sums[k] / total[k], total[k]
