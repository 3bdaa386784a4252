"""Volume rendering of packed samples on the CPU (numba, all cores): forward and backward.

The reference is `efficientnerf.rendering.compositing`. Rays are split into fixed blocks and each ray belongs to one thread, so results depend neither on
timing nor on the number of threads.

R rays, N samples, K harmonics.
"""

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.backends.numba.vector.maths import LOG2_E, absolute, broadcast, exp, exp2_neg, minimum, select, sum_each
from efficientnerf.backends.numba.vector.memory import load_first, pointer, store_first
from efficientnerf.rendering.compositing import LARGEST_LOGIT

BLOCK = 64  # rays per task
LANES = 16
_NONE, _ONE = np.float32(0), np.float32(1)


@numba.njit(cache=True, inline="always", error_model="numpy")
def activate_density(x, exponential):
    """Density of a raw density, and its derivative; exponential, or softplus(x - 1)."""
    one = np.float32(1)
    if exponential:
        if x > np.float32(LARGEST_LOGIT):
            return np.exp(np.float32(LARGEST_LOGIT)), np.float32(0)
        y = np.exp(x)
        return y, y
    z = x - one
    e = np.exp(-abs(z))
    return max(z, np.float32(0)) + np.log1p(e), (one if z >= 0 else e) / (one + e)


@numba.njit(cache=True, error_model="numpy")
def _exp_negative(p, count):
    """exp(-x) of `count` numbers x >= 0, in place."""
    for at in range(0, count, LANES):
        store_first(p, at, exp2_neg(load_first(p, at, count - at, LANES) * LOG2_E), count - at)


@numba.njit(cache=True, error_model="numpy")
def _sigmoid(p, begin, end):
    """In place."""
    for at in range(begin, end, LANES):
        x = load_first(p, at, end - at, LANES)
        e = exp2_neg(absolute(x) * LOG2_E)
        store_first(p, at, select(x < _NONE, e, broadcast(_ONE, LANES)) / (e + _ONE), end - at)


@numba.njit(cache=True, error_model="numpy")
def _transmittances(raw, length, begin, end, exponential, out, slope):
    """exp(-density * length) of samples `begin` to `end` into `out`, and the derivatives of their densities into `slope`."""
    count, p = end - begin, pointer(slope)
    for n in range(count):
        slope[n] = raw[begin + n, 0]
    if exponential:
        for at in range(0, count, LANES):
            x = load_first(p, at, count - at, LANES)
            store_first(p, at, select(x == x, exp(minimum(x, np.float32(LARGEST_LOGIT))), x), count - at)  # what is no number stays so
    for n in range(count):
        density = slope[n]
        if not exponential:
            density, slope[n] = activate_density(density, False)
        elif raw[begin + n, 0] > np.float32(LARGEST_LOGIT):
            slope[n] = _NONE
        out[n] = density * length[begin + n]
    _exp_negative(pointer(out), count)


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def composite(raw, length, first, harmonics, background, exponential, colour, opacity, distortion, weight, rgb):
    """`efficientnerf.rendering.compositing.composite`, forward.

    raw, length, first     packed samples: (N, 1 + 3K), (N,), (R + 1,); K at most 16
    harmonics, background  (R, K), (R, 3)
    written                colour (R, 3), opacity (R,), distortion (R,), weight (N,), rgb (N, 3)
    """
    terms = harmonics.shape[1]
    one = np.float32(1)
    rays = len(first) - 1
    for block in numba.prange((rays + BLOCK - 1) // BLOCK):
        last = min(rays, (block + 1) * BLOCK)
        begin, end = first[block * BLOCK], first[last]
        _transmittances(raw, length, begin, end, exponential, weight[begin:end], np.empty(end - begin, np.float32))
        p, q = pointer(raw), pointer(rgb)
        for r in range(block * BLOCK, last):
            basis = load_first(pointer(harmonics), r * terms, terms, LANES)
            for n in range(first[r], first[r + 1]):
                row = n * (1 + 3 * terms) + 1
                red, green, blue = load_first(p, row, terms, LANES), load_first(p, row + terms, terms, LANES), load_first(p, row + 2 * terms, terms, LANES)
                store_first(q, 3 * n, sum_each((red * basis, green * basis, blue * basis)), 3)
        _sigmoid(q, 3 * begin, 3 * end)
        for r in range(block * BLOCK, last):
            transmittance = one
            c0 = c1 = c2 = np.float32(0)
            at = distortion_sum = front_weight = front_moment = np.float32(0)
            for n in range(first[r], first[r + 1]):
                w = transmittance * (one - weight[n])
                transmittance *= weight[n]
                c0 += w * rgb[n, 0]
                c1 += w * rgb[n, 1]
                c2 += w * rgb[n, 2]
                weight[n] = w
                middle = at + np.float32(0.5) * length[n]
                distortion_sum += np.float32(2) * w * (middle * front_weight - front_moment) + w * w * length[n] / np.float32(3)
                front_weight += w
                front_moment += w * middle
                at += length[n]
            distortion[r] = distortion_sum
            colour[r, 0] = c0 + transmittance * background[r, 0]
            colour[r, 1] = c1 + transmittance * background[r, 1]
            colour[r, 2] = c2 + transmittance * background[r, 2]
            opacity[r] = one - transmittance


@numba.njit(cache=True, inline="always", error_model="numpy")
def _weight_grad(g0, g1, g2, rgb, g_distortion, w, length, middle, front_weight, front_moment, all_weight, all_moment):
    """Gradient with respect to a sample's weight: of the colours, and of the distortion loss, 2 sum_j w_j |s - s_j| + 2/3 w l."""
    two = np.float32(2)
    back_weight, back_moment = all_weight - front_weight - w, all_moment - front_moment - w * middle
    distortion = two * (middle * front_weight - front_moment + back_moment - middle * back_weight) + two / np.float32(3) * w * length
    return g0 * rgb[0] + g1 * rgb[1] + g2 * rgb[2] + g_distortion * distortion


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def composite_backward(
    raw, length, first, harmonics, background, exponential, weight, rgb,
    grad_colour, grad_opacity, grad_distortion, grad_weight, grad_raw, grad_background,
):  # fmt: skip
    """Gradients of colour, opacity, distortion and weights with respect to raw and background."""
    terms = harmonics.shape[1]
    one = np.float32(1)
    rays = len(first) - 1
    for block in numba.prange((rays + BLOCK - 1) // BLOCK):
        last = min(rays, (block + 1) * BLOCK)
        begin, end = first[block * BLOCK], first[last]
        passed, slope = np.empty(end - begin, np.float32), np.empty(end - begin, np.float32)
        _transmittances(raw, length, begin, end, exponential, passed, slope)
        for r in range(block * BLOCK, last):
            g0, g1, g2 = grad_colour[r, 0], grad_colour[r, 1], grad_colour[r, 2]
            g_transmittance = g0 * background[r, 0] + g1 * background[r, 1] + g2 * background[r, 2] - grad_opacity[r]
            # `rest` is what the background and the samples behind sample n contribute: the total, less the samples' up to n, front to back.
            transmittance = one
            rest = np.float32(0)
            at = all_weight = all_moment = np.float32(0)
            g_distortion = grad_distortion[r]
            for n in range(first[r], first[r + 1]):
                transmittance -= weight[n]
                all_weight += weight[n]
                all_moment += weight[n] * (at + np.float32(0.5) * length[n])
                at += length[n]
            at = front_weight = front_moment = np.float32(0)
            for n in range(first[r], first[r + 1]):
                w, middle = weight[n], at + np.float32(0.5) * length[n]
                own = grad_weight[n] + _weight_grad(g0, g1, g2, rgb[n], g_distortion, w, length[n], middle, front_weight, front_moment, all_weight, all_moment)
                grad_raw[n, 0] = own
                rest += w * own
                front_weight += w
                front_moment += w * middle
                at += length[n]
            transmittance = max(transmittance, np.float32(0))
            rest += transmittance * g_transmittance
            grad_background[r, 0], grad_background[r, 1], grad_background[r, 2] = transmittance * g0, transmittance * g1, transmittance * g2
            before = one
            for n in range(first[r], first[r + 1]):
                w, own = weight[n], grad_raw[n, 0]
                rest -= w * own
                after = before * passed[n - begin]
                grad_raw[n, 0] = (after * own - rest) * length[n] * slope[n - begin]
                before = after
                d0, d1, d2 = w * g0 * rgb[n, 0] * (one - rgb[n, 0]), w * g1 * rgb[n, 1] * (one - rgb[n, 1]), w * g2 * rgb[n, 2] * (one - rgb[n, 2])
                for k in range(terms):
                    grad_raw[n, 1 + k] = d0 * harmonics[r, k]
                    grad_raw[n, 1 + terms + k] = d1 * harmonics[r, k]
                    grad_raw[n, 1 + 2 * terms + k] = d2 * harmonics[r, k]


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def scaled_by_distance(values, start, first, subject, out):
    """`efficientnerf.rendering.compositing.scaled_by_distance`; writes out (N, C)."""
    rays, one = len(subject), np.float32(1)
    for block in numba.prange((rays + BLOCK - 1) // BLOCK):
        for r in range(block * BLOCK, min(rays, (block + 1) * BLOCK)):
            for n in range(first[r], first[r + 1]):
                ratio = min(start[n] / subject[r], one)
                for column in range(values.shape[1]):
                    out[n, column] = values[n, column] * (ratio * ratio)
