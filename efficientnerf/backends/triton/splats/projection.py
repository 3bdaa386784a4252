"""Gaussians into images on CUDA (Triton), a lane each, as `efficientnerf.backends.numba.splats.projection` does it.

Values lie in rows: (11 + 3 K, N) float32, rows as `efficientnerf.backends.splat_layout` names them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import triton
import triton.language as tl

from efficientnerf.backends import splat_layout as layout
from efficientnerf.backends.triton.harmonics import harmonic
from efficientnerf.backends.triton.vectors import Vec3, sigmoid

MEAN, SCALE, ROTATION = (tl.constexpr(row) for row in (layout.MEAN, layout.SCALE, layout.ROTATION))
OPACITY, HARMONICS = tl.constexpr(layout.OPACITY), tl.constexpr(layout.HARMONICS)
X, Y, CONIC_A, CONIC_B, CONIC_C = (tl.constexpr(at) for at in (layout.X, layout.Y, layout.CONIC_A, layout.CONIC_B, layout.CONIC_C))
ALPHA, RED, DEPTH, RECORD = (tl.constexpr(at) for at in (layout.ALPHA, layout.RED, layout.DEPTH, layout.RECORD))
LOW_PASS, REACH_255 = tl.constexpr(float(layout.LOW_PASS)), tl.constexpr(float(layout.REACH_255))
LEAST_ALPHA, MOST_LOG_SCALE = tl.constexpr(float(layout.LEAST_ALPHA)), tl.constexpr(float(layout.MOST_LOG_SCALE))
TILE = tl.constexpr(layout.TILE)
HALF_TURN = tl.constexpr(1.5707964)


class Lens(NamedTuple):
    """Numbers of `splat_layout.Lens`, in tuples of float; size: width and height of the picture."""

    turn: Any
    centre: Any
    numbers: Any
    limits: Any
    size: Any


class Projected(NamedTuple):
    """Gaussians in an image. Derivatives by a point are of x and of y, by the point of the world or, turned, by that along the Gaussian's axes."""

    x: Any
    y: Any
    depth: Any
    seen: Any  # whether the lens sees it
    by_x: Any  # Vec3
    by_y: Any
    turned_x: Any
    turned_y: Any
    scales: Any  # Vec3 of standard deviations
    quaternion: Any  # w, x, y, z, unit
    length: Any  # of the quaternion as it is stored


class Conic(NamedTuple):
    """Covariances in the image, xx and yy, their inverse a, b, c, and the derivatives by the three axes, scaled."""

    xx: Any
    yy: Any
    a: Any
    b: Any
    c: Any
    ax: Any
    ay: Any


@triton.jit
def _clamped(x, low, high):
    return tl.minimum(tl.maximum(x, low), high)


@triton.jit
def _dot(a, b):
    return a.x * b.x + a.y * b.y + a.z * b.z


@triton.jit
def _arctangent(t):
    """Of t >= 0, to 3e-7."""
    x = tl.where(t > 1, 1 / tl.maximum(t, 1e-30), t)
    x = x / (1 + tl.sqrt(1 + x * x))
    y = x * x
    series = 0.11111111 - y * (0.09090909 - y * 0.07692308)
    series = 1 - y * (0.33333333 - y * (0.2 - y * (0.14285715 - y * series)))
    angle = 2 * x * series
    return tl.where(t > 1, -angle + HALF_TURN, angle)


@triton.jit
def _plane(x, y, z, lens, FISHEYE: tl.constexpr):
    """Points of the camera on the undistorted plane (u, v), whether each can be seen there, and the derivatives of u and v (Vec3), kept within the limits."""
    nearest = lens.numbers[13]
    if FISHEYE:
        square = x * x + y * y
        across = tl.sqrt(tl.maximum(square, 1e-20))
        whole = square + z * z
        angle = 2 * _arctangent(across / tl.maximum(tl.sqrt(whole) + z, 1e-12))
        nx, ny = x / across, y / across
        seen, whole = whole > nearest * nearest, tl.maximum(whole, 1e-20)
        per = tl.where(across < 1e-5 * z, 1 / tl.maximum(z, 1e-12), angle / across)  # angle / across is 1 / z where it is straight ahead
        along, back = z / whole, -across / whole
        cross = nx * ny * (along - per)
        by_u = Vec3(nx * nx * along + (1 - nx * nx) * per, cross, nx * back)
        by_v = Vec3(cross, ny * ny * along + (1 - ny * ny) * per, ny * back)
    else:
        seen = z > nearest
        per = 1 / tl.where(seen, z, 1.0)
        zero = tl.zeros_like(per)
        by_u = Vec3(per, zero, -_clamped(x * per, lens.limits[0], lens.limits[1]) * per)
        by_v = Vec3(zero, per, -_clamped(y * per, lens.limits[2], lens.limits[3]) * per)
    return x * per, y * per, seen, by_u, by_v


@triton.jit
def _distorted(u, v, n):
    """Points of the undistorted plane, distorted by the numbers of a lens, and the derivative: x_u, x_v and y_u, y_v."""
    s = u * u + v * v
    top = ((s * n[7] + n[6]) * s + n[5]) * s + n[4]
    top_slope = ((s * (4 * n[7]) + 3 * n[6]) * s + 2 * n[5]) * s + n[4]
    bottom = ((s * n[10] + n[9]) * s + n[8]) * s + 1
    bottom_slope = (s * (3 * n[10]) + 2 * n[9]) * s + n[8]
    radial = (top * s + 1) / bottom
    slope = (top_slope - radial * bottom_slope) / bottom
    p1, p2 = n[11], n[12]
    x = u * radial + 2 * p1 * u * v + p2 * (s + 2 * u * u)
    y = v * radial + 2 * p2 * u * v + p1 * (s + 2 * v * v)
    cross = 2 * u * v * slope + 2 * p1 * u + 2 * p2 * v
    return x, y, radial + 2 * u * u * slope + 2 * p1 * v + 6 * p2 * u, cross, radial + 2 * v * v * slope + 6 * p1 * v + 2 * p2 * u


@triton.jit
def _chained(u, v, by_u, by_v):
    """u by_u + v by_v"""
    return Vec3(u * by_u.x + v * by_v.x, u * by_u.y + v * by_v.y, u * by_u.z + v * by_v.z)


@triton.jit
def _in_world(j, t):
    """A derivative by the point of the camera as one by that of the world; t: rows of the rotation between them."""
    return Vec3(j.x * t[0] + j.y * t[3] + j.z * t[6], j.x * t[1] + j.y * t[4] + j.z * t[7], j.x * t[2] + j.y * t[5] + j.z * t[8])


@triton.jit
def _along_axes(d, w, x, y, z):
    """A derivative by the point of the world as those along the axes of the rotation of a unit quaternion."""
    return Vec3(
        d.x * (1 - 2 * (y * y + z * z)) + d.y * 2 * (x * y + w * z) + d.z * 2 * (x * z - w * y),
        d.x * 2 * (x * y - w * z) + d.y * (1 - 2 * (x * x + z * z)) + d.z * 2 * (y * z + w * x),
        d.x * 2 * (x * z + w * y) + d.y * 2 * (y * z - w * x) + d.z * (1 - 2 * (x * x + y * y)),
    )


@triton.jit
def load_rows(values, row, n, count, live):
    """Three rows from `row` on (Vec3)."""
    at = values + count * row + n
    return Vec3(tl.load(at, live, other=0.0), tl.load(at + count, live, other=0.0), tl.load(at + 2 * count, live, other=0.0))


@triton.jit
def image_of(values, n, count, live, lens, FISHEYE: tl.constexpr):
    """Gaussians n in the image, as Projected."""
    t, k, mean = lens.turn, lens.numbers, load_rows(values, MEAN, n, count, live)
    a, b, c = mean.x - lens.centre[0], mean.y - lens.centre[1], mean.z - lens.centre[2]
    x, y, z = a * t[0] + b * t[1] + c * t[2], a * t[3] + b * t[4] + c * t[5], a * t[6] + b * t[7] + c * t[8]
    u, v, seen, by_u, by_v = _plane(x, y, z, lens, FISHEYE)
    px, py, x_u, cross, y_v = _distorted(u, v, k)
    seen = seen & (u * u + v * v < k[14])
    depth = z
    if FISHEYE:
        depth = tl.sqrt(x * x + y * y + z * z)
    else:
        at_u, at_v = _clamped(u, lens.limits[0], lens.limits[1]), _clamped(v, lens.limits[2], lens.limits[3])
        _, _, x_u, cross, y_v = _distorted(at_u, at_v, k)
    by_x, by_y = _in_world(_chained(k[0] * x_u, k[0] * cross, by_u, by_v), t), _in_world(_chained(k[1] * cross, k[1] * y_v, by_u, by_v), t)
    turn, w = load_rows(values, ROTATION + 1, n, count, live), tl.load(values + count * ROTATION + n, live, other=1.0)
    length = tl.sqrt(tl.maximum(w * w + _dot(turn, turn), 1e-20))
    qw, qx, qy, qz = w / length, turn.x / length, turn.y / length, turn.z / length
    s = load_rows(values, SCALE, n, count, live)
    scales = Vec3(
        tl.exp(_clamped(s.x, -MOST_LOG_SCALE, MOST_LOG_SCALE)), tl.exp(_clamped(s.y, -MOST_LOG_SCALE, MOST_LOG_SCALE)),
        tl.exp(_clamped(s.z, -MOST_LOG_SCALE, MOST_LOG_SCALE)),
    )  # fmt: skip
    turned_x, turned_y = _along_axes(by_x, qw, qx, qy, qz), _along_axes(by_y, qw, qx, qy, qz)
    return Projected(px * k[0] + k[2], py * k[1] + k[3], depth, seen, by_x, by_y, turned_x, turned_y, scales, (qw, qx, qy, qz), length)


@triton.jit
def conic_of(p):
    """The Conic of Projected."""
    ax = Vec3(p.turned_x.x * p.scales.x, p.turned_x.y * p.scales.y, p.turned_x.z * p.scales.z)
    ay = Vec3(p.turned_y.x * p.scales.x, p.turned_y.y * p.scales.y, p.turned_y.z * p.scales.z)
    xx, yy, xy = _dot(ax, ax) + LOW_PASS, _dot(ay, ay) + LOW_PASS, _dot(ax, ay)
    # By differences of large products a needle's determinant would lose all its digits: LOW_PASS alone holds it above zero.
    one, two, three = ax.x * ay.y - ax.y * ay.x, ax.y * ay.z - ax.z * ay.y, ax.z * ay.x - ax.x * ay.z
    determinant = one * one + two * two + three * three + LOW_PASS * (xx + yy - LOW_PASS)
    return Conic(xx, yy, yy / determinant, -xy / determinant, xx / determinant, ax, ay)


@triton.jit
def colour_of(values, n, count, live, lens, K: tl.constexpr):
    """Unit directions that harmonics are seen along, and colours, not clipped (Vec3)."""
    mean = load_rows(values, MEAN, n, count, live)
    x, y, z = mean.x - lens.centre[0], mean.y - lens.centre[1], mean.z - lens.centre[2]
    length = tl.sqrt(tl.maximum(x * x + y * y + z * z, 1e-30))
    view = Vec3(x / length, y / length, z / length)
    red, green, blue = tl.zeros_like(x) + 0.5, tl.zeros_like(x) + 0.5, tl.zeros_like(x) + 0.5
    for k in tl.static_range(K):
        basis, c = harmonic(view, k), load_rows(values, HARMONICS + 3 * k, n, count, live)
        red, green, blue = red + basis * c.x, green + basis * c.y, blue + basis * c.z
    return view, Vec3(red, green, blue)


@triton.jit
def _range(centre, reach, cells):
    """First tile that centre - reach to centre + reach meets, and how many."""
    first = tl.maximum((centre - reach) / TILE, 0.0).to(tl.int32)
    return first, tl.maximum(tl.minimum((centre + reach) / TILE, cells - 1.0).to(tl.int32) + 1 - first, 0)


@triton.jit(do_not_specialize=["count"])
def project(values, records, boxes, count, lens, FISHEYE: tl.constexpr, K: tl.constexpr, BLOCK: tl.constexpr):
    """Records (N, RECORD) float32, and boxes (4, N) int32: column and row of the first tile, columns, and tiles in all, 0 of what is not in the image."""
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = n < count
    p = image_of(values, n, count, live, lens, FISHEYE)
    conic = conic_of(p)
    opacity = sigmoid(tl.load(values + count * OPACITY + n, live, other=0.0))
    reach = tl.maximum(16 * (tl.sqrt(tl.sqrt(tl.sqrt(opacity))) - 1) + REACH_255, 0.0)
    wide, high = tl.sqrt(reach * conic.xx), tl.sqrt(reach * conic.yy)
    seen = p.seen & (opacity >= LEAST_ALPHA) & (p.x + wide > 0) & (p.y + high > 0) & (p.x - wide < lens.size[0]) & (p.y - high < lens.size[1])
    left, columns = _range(tl.where(seen, p.x, 0.0), tl.where(seen, wide, 0.0), tl.ceil(lens.size[0] / TILE))
    top, rows = _range(tl.where(seen, p.y, 0.0), tl.where(seen, high, 0.0), tl.ceil(lens.size[1] / TILE))
    tl.store(boxes + n, left, live)
    tl.store(boxes + count + n, top, live)
    tl.store(boxes + 2 * count + n, columns, live)
    tl.store(boxes + 3 * count + n, tl.where(seen, columns * rows, 0), live)
    _, colour = colour_of(values, n, count, live, lens, K)
    at = records + n * RECORD
    tl.store(at + X, p.x, live)
    tl.store(at + Y, p.y, live)
    tl.store(at + CONIC_A, conic.a, live)
    tl.store(at + CONIC_B, conic.b, live)
    tl.store(at + CONIC_C, conic.c, live)
    tl.store(at + ALPHA, opacity, live)
    tl.store(at + RED, tl.maximum(colour.x, 0.0), live)
    tl.store(at + RED + 1, tl.maximum(colour.y, 0.0), live)
    tl.store(at + RED + 2, tl.maximum(colour.z, 0.0), live)
    tl.store(at + DEPTH, p.depth, live)
