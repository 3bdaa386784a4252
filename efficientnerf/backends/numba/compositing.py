"""Volume rendering of packed samples on the CPU (numba, all cores): forward and backward.

The reference is `efficientnerf.rendering.compositing`. Rays are split into fixed blocks and each ray belongs to one thread, so results depend neither on
timing nor on the number of threads.

R rays, N samples, K harmonics.
"""

import numpy as np

from efficientnerf.backends.numba.runtime import PRANGE, numba
from efficientnerf.rendering.compositing import LARGEST_LOGIT

BLOCK = 64  # rays per task


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


@numba.njit(cache=True, parallel=PRANGE, error_model="numpy")
def composite(raw, length, first, harmonics, background, exponential, colour, opacity, distortion, weight, rgb):
    """`efficientnerf.rendering.compositing.composite`, forward.

    raw, length, first     packed samples: (N, 1 + 3K), (N,), (R + 1,)
    harmonics, background  (R, K), (R, 3)
    written                colour (R, 3), opacity (R,), distortion (R,), weight (N,), rgb (N, 3)
    """
    terms = harmonics.shape[1]
    one = np.float32(1)
    rays = len(first) - 1
    for block in numba.prange((rays + BLOCK - 1) // BLOCK):
        for r in range(block * BLOCK, min(rays, (block + 1) * BLOCK)):
            transmittance = one
            c0 = c1 = c2 = np.float32(0)
            at = distortion_sum = front_weight = front_moment = np.float32(0)
            for n in range(first[r], first[r + 1]):
                density, _ = activate_density(raw[n, 0], exponential)
                alpha = one - np.exp(-density * length[n])
                w = transmittance * alpha
                transmittance *= one - alpha
                for channel in range(3):
                    total = np.float32(0)
                    for k in range(terms):
                        total += harmonics[r, k] * raw[n, 1 + channel * terms + k]
                    rgb[n, channel] = one / (one + np.exp(-total))
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
        for r in range(block * BLOCK, min(rays, (block + 1) * BLOCK)):
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
                middle = at + np.float32(0.5) * length[n]
                weight_grad = _weight_grad(g0, g1, g2, rgb[n], g_distortion, weight[n], length[n], middle, front_weight, front_moment, all_weight, all_moment)
                rest += weight[n] * (grad_weight[n] + weight_grad)
                front_weight += weight[n]
                front_moment += weight[n] * middle
                at += length[n]
            transmittance = max(transmittance, np.float32(0))
            rest += transmittance * g_transmittance
            grad_background[r, 0], grad_background[r, 1], grad_background[r, 2] = transmittance * g0, transmittance * g1, transmittance * g2
            before = one
            at = front_weight = front_moment = np.float32(0)
            for n in range(first[r], first[r + 1]):
                density, slope = activate_density(raw[n, 0], exponential)
                w = weight[n]
                middle = at + np.float32(0.5) * length[n]
                own = grad_weight[n] + _weight_grad(g0, g1, g2, rgb[n], g_distortion, w, length[n], middle, front_weight, front_moment, all_weight, all_moment)
                front_weight += w
                front_moment += w * middle
                at += length[n]
                rest -= w * own
                after = before * np.exp(-density * length[n])
                grad_raw[n, 0] = (after * own - rest) * length[n] * slope
                before = after
                for channel in range(3):
                    g = g0 if channel == 0 else (g1 if channel == 1 else g2)
                    c = rgb[n, channel]
                    d = w * g * c * (one - c)
                    for k in range(terms):
                        grad_raw[n, 1 + channel * terms + k] = d * harmonics[r, k]


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
