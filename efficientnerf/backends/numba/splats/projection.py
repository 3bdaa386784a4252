"""Gaussians into images, sixteen at a time (numba): Zwicker et al. 2001, "EWA splatting", as 3DGS has it.

A mean goes through the camera, lens and all; the covariance through the derivative of that map at the mean, and grows by LOW_PASS square pixels. Where 3DGS
knows pinholes alone, the derivative here includes the lens: distorted pictures are rendered as they are. Beside the picture it is taken at the border of what
`lens_of` allows.

Values lie in groups of sixteen Gaussians: (G, rows, 16) float32, rows as `efficientnerf.backends.splat_layout` names them, 3 K of them
harmonics, coefficient by coefficient.
"""

import numpy as np

from efficientnerf.backends import splat_layout as layout
from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.tree.view_colours import sh_basis
from efficientnerf.backends.numba.vector.maths import arctangent, broadcast, exp, maximum, minimum, select, sigmoid, sqrt
from efficientnerf.backends.numba.vector.memory import load, load_three, pointer, store, store_three
from efficientnerf.backends.splat_layout import LANES

GROUPS_A_TASK = 64
_NONE, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _clamped(x, low, high):
    return minimum(maximum(x, low), high)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _plane(x, y, z, lens):
    """Points of the camera on the undistorted plane (u, v), whether each can be seen there, and the derivative of (u, v), kept within the limits: three numbers
    each."""
    if lens.fisheye:
        square = x * x + y * y
        across, whole = sqrt(maximum(square, np.float32(1e-20))), square + z * z
        angle = _TWO * arctangent(across / maximum(sqrt(whole) + z, np.float32(1e-12)))
        nx, ny, whole = x / across, y / across, maximum(whole, np.float32(1e-20))
        straight = across < np.float32(1e-5) * z  # angle / across is 1 / z there
        per, along = select(straight, _ONE / maximum(z, np.float32(1e-12)), angle / across), z / whole
        cross, back = nx * ny * (along - per), across / whole * np.float32(-1)
        u_x, v_y = nx * nx * along + (_ONE - nx * nx) * per, ny * ny * along + (_ONE - ny * ny) * per
        return x * per, y * per, whole > lens.numbers[13] * lens.numbers[13], u_x, cross, nx * back, cross, v_y, ny * back
    ahead = z > lens.numbers[13]
    per = _ONE / select(ahead, z, _ONE)
    u, v = x * per, y * per
    u_near, v_near = _clamped(u, lens.limits[0], lens.limits[1]), _clamped(v, lens.limits[2], lens.limits[3])
    zero = broadcast(_NONE, LANES)
    return u, v, ahead, per, zero, u_near * per * np.float32(-1), zero, per, v_near * per * np.float32(-1)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _distorted(u, v, lens):
    """Points of the undistorted plane, distorted, and the derivative: x_u, x_v, y_u, y_v."""
    n = lens.numbers
    s = u * u + v * v
    top = ((s * n[7] + n[6]) * s + n[5]) * s + n[4]
    top_slope = ((s * (np.float32(4) * n[7]) + np.float32(3) * n[6]) * s + _TWO * n[5]) * s + n[4]
    bottom = ((s * n[10] + n[9]) * s + n[8]) * s + _ONE
    bottom_slope = (s * (np.float32(3) * n[10]) + _TWO * n[9]) * s + n[8]
    radial = (top * s + _ONE) / bottom
    slope = (top_slope - radial * bottom_slope) / bottom
    p1, p2 = n[11], n[12]
    x = u * radial + _TWO * p1 * u * v + p2 * (s + _TWO * u * u)
    y = v * radial + _TWO * p2 * u * v + p1 * (s + _TWO * v * v)
    cross = _TWO * u * v * slope + _TWO * p1 * u + _TWO * p2 * v
    x_u = radial + _TWO * u * u * slope + _TWO * p1 * v + np.float32(6) * p2 * u
    y_v = radial + _TWO * v * v * slope + np.float32(6) * p1 * v + _TWO * p2 * u
    return x, y, x_u, cross, cross, y_v


@numba.njit(cache=True, inline="always", error_model="numpy")
def rotation16(p, at):
    """The unit quaternion of a group and its length, and the matrix by rows."""
    at += 16 * layout.ROTATION
    w, x, y, z = load(p, at, LANES), load(p, at + 16, LANES), load(p, at + 32, LANES), load(p, at + 48, LANES)
    length = sqrt(maximum(w * w + x * x + y * y + z * z, np.float32(1e-20)))
    w, x, y, z = w / length, x / length, y / length, z / length
    matrix = (
        _ONE - _TWO * (y * y + z * z), _TWO * (x * y - w * z), _TWO * (x * z + w * y),
        _TWO * (x * y + w * z), _ONE - _TWO * (x * x + z * z), _TWO * (y * z - w * x),
        _TWO * (x * z - w * y), _TWO * (y * z + w * x), _ONE - _TWO * (x * x + y * y),
    )  # fmt: skip
    return (w, x, y, z), length, matrix


@numba.njit(cache=True, inline="always", error_model="numpy")
def _from_centre16(p, at, lens):
    """Means of a group, from the camera's centre."""
    x, y, z = load_three(p, at, LANES)
    return x - lens.centre[0], y - lens.centre[1], z - lens.centre[2]


@numba.njit(cache=True, inline="always", error_model="numpy")
def image16(p, at, lens):
    """A group in the image: (x, y) pixels, depth, whether it can be seen; the derivative of (x, y) by the point of the world (2, 3); that times the rotation
    (2, 3); the standard deviations; and the rotation."""
    t, n = lens.turn, lens.numbers
    a, b, c = _from_centre16(p, at, lens)
    x, y, z = a * t[0] + b * t[1] + c * t[2], a * t[3] + b * t[4] + c * t[5], a * t[6] + b * t[7] + c * t[8]
    u, v, seen, u_x, u_y, u_z, v_x, v_y, v_z = _plane(x, y, z, lens)
    seen = seen & (u * u + v * v < n[14])
    px, py, _a, _b, _c, _d = _distorted(u, v, lens)
    at_u, at_v = (u, v) if lens.fisheye else (_clamped(u, lens.limits[0], lens.limits[1]), _clamped(v, lens.limits[2], lens.limits[3]))
    _x, _y, x_u, x_v, y_u, y_v = _distorted(at_u, at_v, lens)
    jx = (n[0] * (x_u * u_x + x_v * v_x), n[0] * (x_u * u_y + x_v * v_y), n[0] * (x_u * u_z + x_v * v_z))
    jy = (n[1] * (y_u * u_x + y_v * v_x), n[1] * (y_u * u_y + y_v * v_y), n[1] * (y_u * u_z + y_v * v_z))
    wx = (jx[0] * t[0] + jx[1] * t[3] + jx[2] * t[6], jx[0] * t[1] + jx[1] * t[4] + jx[2] * t[7], jx[0] * t[2] + jx[1] * t[5] + jx[2] * t[8])
    wy = (jy[0] * t[0] + jy[1] * t[3] + jy[2] * t[6], jy[0] * t[1] + jy[1] * t[4] + jy[2] * t[7], jy[0] * t[2] + jy[1] * t[5] + jy[2] * t[8])
    turned = rotation16(p, at)
    r = turned[2]
    nx = (wx[0] * r[0] + wx[1] * r[3] + wx[2] * r[6], wx[0] * r[1] + wx[1] * r[4] + wx[2] * r[7], wx[0] * r[2] + wx[1] * r[5] + wx[2] * r[8])
    ny = (wy[0] * r[0] + wy[1] * r[3] + wy[2] * r[6], wy[0] * r[1] + wy[1] * r[4] + wy[2] * r[7], wy[0] * r[2] + wy[1] * r[5] + wy[2] * r[8])
    one, two, three = load_three(p, at + 16 * layout.SCALE, LANES)
    low, high = -layout.MOST_LOG_SCALE, layout.MOST_LOG_SCALE
    scales = exp(_clamped(one, low, high)), exp(_clamped(two, low, high)), exp(_clamped(three, low, high))
    depth = sqrt(x * x + y * y + z * z) if lens.fisheye else z
    return px * n[0] + n[2], py * n[1] + n[3], depth, seen, wx, wy, nx, ny, scales, turned


@numba.njit(cache=True, inline="always", error_model="numpy")
def conic16(nx, ny, scales):
    """The covariance in the image (xx, xy, yy) with LOW_PASS, and its inverse."""
    ax, ay = (nx[0] * scales[0], nx[1] * scales[1], nx[2] * scales[2]), (ny[0] * scales[0], ny[1] * scales[1], ny[2] * scales[2])
    xx, yy = ax[0] * ax[0] + ax[1] * ax[1] + ax[2] * ax[2] + layout.LOW_PASS, ay[0] * ay[0] + ay[1] * ay[1] + ay[2] * ay[2] + layout.LOW_PASS
    xy = ax[0] * ay[0] + ax[1] * ay[1] + ax[2] * ay[2]
    # By differences of large products a needle's determinant would lose all its digits: LOW_PASS alone holds it above zero.
    one, two, three = ax[0] * ay[1] - ax[1] * ay[0], ax[1] * ay[2] - ax[2] * ay[1], ax[2] * ay[0] - ax[0] * ay[2]
    determinant = one * one + two * two + three * three + layout.LOW_PASS * (xx + yy - layout.LOW_PASS)
    return ax, ay, (xx, xy, yy), (yy / determinant, xy * np.float32(-1) / determinant, xx / determinant)


@numba.njit(cache=True, inline="always", error_model="numpy")
def basis16(p, at, lens, degree, out):
    """Harmonics of the view directions of a group, `out` (K, 16)."""
    x, y, z = _from_centre16(p, at, lens)
    length = sqrt(maximum(x * x + y * y + z * z, np.float32(1e-30)))
    sh_basis(x / length, y / length, z / length, degree, out)


@numba.njit(cache=True, inline="always", error_model="numpy")
def colour16(p, at, degree, basis):
    """1/2 + the sum of the harmonics of a group, three channels; not clipped."""
    red, green, blue = broadcast(_HALF, LANES), broadcast(_HALF, LANES), broadcast(_HALF, LANES)
    for k in range((degree + 1) * (degree + 1)):
        value, row = load(basis, 16 * k, LANES), at + 16 * (layout.HARMONICS + 3 * k)
        r, g, b = load_three(p, row, LANES)
        red, green, blue = red + value * r, green + value * g, blue + value * b
    return red, green, blue


@numba.njit(cache=True, error_model="numpy")
def _project_group(p, at, lens, degree, basis, row, out, first):
    """Records of a group into out[first : first + 16]; WIDTH is 0 for what is not in the image."""
    x, y, depth, seen, _wx, _wy, nx, ny, scales, _turned = image16(p, at, lens)
    _ax, _ay, covariance, conic = conic16(nx, ny, scales)
    opacity = sigmoid(load(p, at + 16 * layout.OPACITY, LANES))
    reach = layout.REACH_255 + np.float32(16) * (sqrt(sqrt(sqrt(opacity))) - _ONE)
    reach = maximum(reach, _NONE)
    wide, high = sqrt(reach * covariance[0]), sqrt(reach * covariance[2])
    seen = seen & (opacity >= layout.LEAST_ALPHA) & (x + wide > _NONE) & (y + high > _NONE)
    seen = seen & (x - wide < np.float32(lens.width)) & (y - high < np.float32(lens.height))
    basis16(p, at, lens, degree, basis)
    red, green, blue = colour16(p, at, degree, basis)
    store(row, 16 * layout.X, x)
    store(row, 16 * layout.Y, y)
    store_three(row, 16 * layout.CONIC_A, LANES, conic[0], conic[1], conic[2])
    store(row, 16 * layout.ALPHA, opacity)
    store_three(row, 16 * layout.RED, LANES, maximum(red, _NONE), maximum(green, _NONE), maximum(blue, _NONE))
    store(row, 16 * layout.WIDTH, select(seen, wide, _NONE))
    store(row, 16 * layout.HEIGHT, select(seen, high, _NONE))
    store(row, 16 * layout.DEPTH, depth)
    store(row, 16 * layout.REACH, reach)
    for lane in range(LANES):
        for n in range(layout.REACH + 1):
            out[first + lane, n] = row[16 * n + lane]


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def project(values, lens, degree, out):
    """Records (16 G, RECORD) float32 of Gaussians (G, rows, 16), in the image of a lens."""
    groups, rows = values.shape[0], values.shape[1]
    for task in numba.prange((groups + GROUPS_A_TASK - 1) // GROUPS_A_TASK):
        basis, row, p = np.empty(16 * 16, np.float32), np.empty(16 * layout.RECORD, np.float32), pointer(values)
        for group in range(task * GROUPS_A_TASK, min(groups, (task + 1) * GROUPS_A_TASK)):
            _project_group(p, np.int64(group) * rows * LANES, lens, degree, pointer(basis), pointer(row), out, group * LANES)
