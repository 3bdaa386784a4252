"""Steps of Gaussians down the error of an image, sixteen at a time (numba): back through the projection, then Adam.

Each Gaussian owns the sums of its pairs, adds them in their order, and takes its step alone. Those without a pair stay as they are, and their moments too.
The derivative of the projection, and the direction that harmonics are seen along, count as constants in the derivative by a mean: they change little over a
Gaussian's size. 3DGS carries them along.

Squares of gradients are averaged over a Gaussian's mean, scales, rotation, opacity, base colour and other harmonics, one number each.
"""

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.splats.projection import LANES, basis16, colour16, conic16, image16
from efficientnerf.backends.numba.vector.maths import broadcast, maximum, minimum, select, sigmoid, sqrt
from efficientnerf.backends.numba.vector.memory import load, load_three, pointer, store, store_three
from efficientnerf.backends.splat_layout import DRAWS, ERROR, GRADIENTS, HARMONICS, MEAN, OPACITY, PARTS, ROTATION, SCALE, SQUARES, SUMS

GROUPS_A_TASK = 64
_NONE, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)


@numba.njit(cache=True, inline="always", error_model="numpy")
def _gather_sums(group, first, sums, total):
    """Sums of the pairs of a group, `total` (SUMS, 16) by kinds; returns bits of the Gaussians that have any, as float32 0 or 1 in row SUMS."""
    some = False
    for lane in range(LANES):
        n = group * LANES + lane
        begin, end = first[n], first[n + 1]
        some |= end > begin
        for kind in range(ERROR + 1):
            value = _NONE
            for slot in range(begin, end):
                value += sums[slot, kind]
            total[16 * kind + lane] = value
        total[16 * SUMS + lane] = _ONE if end > begin else _NONE
    return some


@numba.njit(cache=True, error_model="numpy")
def _geometry_gradients(p, at, lens, total, out):
    """Gradients by mean, logarithms of scales, quaternion and logit into rows MEAN to OPACITY of `out`; returns the longest standard deviation."""
    _x, _y, _depth, _seen, wx, wy, nx, ny, s, turned = image16(p, at, lens)
    ax, ay, _covariance, (a, b, c) = conic16(nx, ny, s)
    v, vx, vy = load_three(total, 0, LANES)
    vxx, vxy, vyy = load_three(total, 48, LANES)
    px, py = a * vx + b * vy, b * vx + c * vy
    store_three(out, 16 * MEAN, LANES, px * wx[0] + py * wy[0], px * wx[1] + py * wy[1], px * wx[2] + py * wy[2])
    # By the covariance in the image: half of Q V Q, Q the conic; by its root A twice that times A.
    qx, qy, rx, ry = a * vxx + b * vxy, a * vxy + b * vyy, b * vxx + c * vxy, b * vxy + c * vyy
    hxx, hxy, hyy = qx * a + qy * b, qx * b + qy * c, rx * b + ry * c
    dx0, dx1, dx2 = hxx * ax[0] + hxy * ay[0], hxx * ax[1] + hxy * ay[1], hxx * ax[2] + hxy * ay[2]
    dy0, dy1, dy2 = hxy * ax[0] + hyy * ay[0], hxy * ax[1] + hyy * ay[1], hxy * ax[2] + hyy * ay[2]
    store_three(out, 16 * SCALE, LANES, dx0 * ax[0] + dy0 * ay[0], dx1 * ax[1] + dy1 * ay[1], dx2 * ax[2] + dy2 * ay[2])
    dx0, dx1, dx2, dy0, dy1, dy2 = dx0 * s[0], dx1 * s[1], dx2 * s[2], dy0 * s[0], dy1 * s[1], dy2 * s[2]
    (w, x, y, z), length, _matrix = turned
    g00, g01, g02 = wx[0] * dx0 + wy[0] * dy0, wx[0] * dx1 + wy[0] * dy1, wx[0] * dx2 + wy[0] * dy2
    g10, g11, g12 = wx[1] * dx0 + wy[1] * dy0, wx[1] * dx1 + wy[1] * dy1, wx[1] * dx2 + wy[1] * dy2
    g20, g21, g22 = wx[2] * dx0 + wy[2] * dy0, wx[2] * dx1 + wy[2] * dy1, wx[2] * dx2 + wy[2] * dy2
    by_w = _TWO * (y * (g02 - g20) + z * (g10 - g01) + x * (g21 - g12))
    by_x = _TWO * (y * (g01 + g10) + z * (g02 + g20) + w * (g21 - g12) - _TWO * x * (g11 + g22))
    by_y = _TWO * (x * (g01 + g10) + z * (g12 + g21) + w * (g02 - g20) - _TWO * y * (g00 + g22))
    by_z = _TWO * (x * (g02 + g20) + y * (g12 + g21) + w * (g10 - g01) - _TWO * z * (g00 + g11))
    along = by_w * w + by_x * x + by_y * y + by_z * z
    store(out, 16 * ROTATION, (by_w - along * w) / length)
    store_three(out, 16 * (ROTATION + 1), LANES, (by_x - along * x) / length, (by_y - along * y) / length, (by_z - along * z) / length)
    store(out, 16 * OPACITY, v * (_ONE - sigmoid(load(p, at + 16 * OPACITY, LANES))))
    return maximum(s[0], maximum(s[1], s[2]))


@numba.njit(cache=True, error_model="numpy")
def _colour_gradients(p, at, lens, degree, total, basis, out):
    """Gradients by the harmonics into rows from HARMONICS on."""
    basis16(p, at, lens, degree, basis)
    red, green, blue = colour16(p, at, degree, basis)
    r, g, b = load_three(total, 96, LANES)
    red, green, blue = select(red > _NONE, r, _NONE), select(green > _NONE, g, _NONE), select(blue > _NONE, b, _NONE)
    for k in range((degree + 1) * (degree + 1)):
        value, row = load(basis, 16 * k, LANES), 16 * (HARMONICS + 3 * k)
        store_three(out, row, LANES, value * red, value * green, value * blue)


@numba.njit(cache=True, error_model="numpy")
def _step_part(p, at, m, to, part, begin, end, rate, ahead, correction, moves, h, gradient):
    """Adam on rows `begin` to `end` of a group whose lanes `moves` are to move."""
    square = broadcast(_NONE, LANES)
    for row in range(begin, end):
        g = load(gradient, 16 * row, LANES)
        square = square + g * g
    old = load(m, to + 16 * (SQUARES + part), LANES)
    square = old * h.decay + square * ((_ONE - h.decay) / np.float32(end - begin))
    store(m, to + 16 * (SQUARES + part), select(moves, square, old))
    scale = ahead * rate / (sqrt(square * correction) + h.epsilon)
    for row in range(begin, end):
        place, before = to + 16 * (GRADIENTS + row), at + 16 * row
        old = load(m, place, LANES)
        mean = old * h.momentum + load(gradient, 16 * row, LANES) * (_ONE - h.momentum)
        store(m, place, select(moves, mean, old))
        value = load(p, before, LANES)
        store(p, before, select(moves, value - scale * mean, value))


@numba.njit(cache=True, error_model="numpy")
def _step_group(p, at, m, to, lens, degree, h, drawn, total, basis, gradient, correct):
    """A step of a group with such sums of its pairs."""
    moves = load(total, 16 * SUMS, LANES) > _HALF
    visits = load(m, to, LANES)
    for lane in range(LANES):
        visit = np.int64(m[to + lane])
        correct[lane] = h.of_mean[min(visit, len(h.of_mean) - 1)]
        correct[16 + lane] = h.of_square[min(visit, len(h.of_square) - 1)]
    ahead, correction = load(correct, 0, LANES), load(correct, 16, LANES)
    longest = _geometry_gradients(p, at, lens, total, gradient)
    _colour_gradients(p, at, lens, degree, total, basis, gradient)
    store(m, to, select(moves, visits + _ONE, visits))
    bounds = (MEAN, SCALE, ROTATION, OPACITY, HARMONICS, HARMONICS + 3, HARMONICS + 3 * (degree + 1) * (degree + 1))
    for part in range(PARTS):  # one call: with literal numbers each would be compiled by itself
        if bounds[part + 1] > bounds[part]:
            rate = longest * h.rates[0] if part == 0 else broadcast(h.rates[part], LANES)
            _step_part(p, at, m, to, part, bounds[part], bounds[part + 1], rate, ahead, correction, moves, h, gradient)
    for n in range(3):
        row = at + 16 * (SCALE + n)
        store(p, row, minimum(maximum(load(p, row, LANES), h.least), h.greatest))
    row = at + 16 * OPACITY
    store(p, row, load(p, row, LANES) - select(moves, h.fade, _NONE))
    far = select(moves, longest * h.noise, _NONE)
    for n in range(3):
        row = at + 16 * (MEAN + n)
        store(p, row, load(p, row, LANES) + far * load(pointer(h.draws), drawn + 16 * n, LANES))


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def step(values, moments, lens, degree, first, sums, h, errors):
    """A step of all Gaussians that have pairs, in place.

    values   (G, rows, 16) float32, see `projection`
    moments  (G, GRADIENTS + rows, 16) float32
    first    (N + 1,) and sums (P, SUMS) of the image's pairs; N at most 16 G
    errors   (N,) float32, raised by each Gaussian's share of the error
    """
    groups, rows = values.shape[0], values.shape[1]
    for task in numba.prange((groups + GROUPS_A_TASK - 1) // GROUPS_A_TASK):
        total, basis = np.empty(16 * (SUMS + 1), np.float32), np.empty(16 * 16, np.float32)
        gradient, correct = np.empty(16 * rows, np.float32), np.empty(32, np.float32)
        p, m = pointer(values), pointer(moments)
        for group in range(task * GROUPS_A_TASK, min(groups, (task + 1) * GROUPS_A_TASK)):
            if _gather_sums(group, first, sums, total):
                _step_group(
                    p, np.int64(group) * rows * LANES, m, np.int64(group) * moments.shape[1] * LANES, lens, degree, h,
                    (h.shift + np.int64(group) * 3 * LANES) % DRAWS, pointer(total), pointer(basis), pointer(gradient), pointer(correct),
                )  # fmt: skip
                for lane in range(LANES):
                    errors[group * LANES + lane] += total[16 * ERROR + lane]
