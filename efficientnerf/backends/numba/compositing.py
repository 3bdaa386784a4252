"""Volume rendering of packed samples on the CPU (numba, all cores): forward and backward.

The reference is `efficientnerf.rendering.compositing`. Rays are split into fixed blocks and each ray belongs to one thread, so results depend neither on
timing nor on the number of threads.

R rays, N samples, K harmonics.
"""

from __future__ import annotations

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from efficientnerf.rendering.compositing import LARGEST_LOGIT

BLOCK = 64  # rays per task


@numba.njit(cache=True, inline="always", error_model="numpy")
def activate_density(x, exponential):  # type: ignore[no-untyped-def]
    """Density and its derivative."""
    one = np.float32(1)
    if exponential:
        if x > np.float32(LARGEST_LOGIT):
            return np.exp(np.float32(LARGEST_LOGIT)), np.float32(0)
        y = np.exp(x)
        return y, y
    z = x - one
    e = np.exp(-abs(z))
    return max(z, np.float32(0)) + np.log1p(e), (one if z >= 0 else e) / (one + e)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def composite(raw, length, first, harmonics, background, exponential, colour, opacity, distortion, weight, rgb):  # type: ignore[no-untyped-def]
    """`efficientnerf.rendering.compositing.composite`, forward."""
    terms = harmonics.shape[1]
    one = np.float32(1)
    rays = len(first) - 1
    for block in numba.prange((rays + BLOCK - 1) // BLOCK):
        for r in range(block * BLOCK, min(rays, (block + 1) * BLOCK)):
            light = one
            c0 = c1 = c2 = np.float32(0)
            at = spread = near_weight = near_moment = np.float32(0)
            for n in range(first[r], first[r + 1]):
                density, _ = activate_density(raw[n, 0], exponential)
                alpha = one - np.exp(-density * length[n])
                w = light * alpha
                light *= one - alpha
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
                spread += np.float32(2) * w * (middle * near_weight - near_moment) + w * w * length[n] / np.float32(3)
                near_weight += w
                near_moment += w * middle
                at += length[n]
            distortion[r] = spread
            colour[r, 0] = c0 + light * background[r, 0]
            colour[r, 1] = c1 + light * background[r, 1]
            colour[r, 2] = c2 + light * background[r, 2]
            opacity[r] = one - light


@numba.njit(cache=True, inline="always", error_model="numpy")
def _pull(g0, g1, g2, rgb, gs, w, length, middle, near_weight, near_moment, all_weight, all_moment):  # type: ignore[no-untyped-def]
    """Gradient with respect to a sample's weight: of the colours, and of the distortion, 2 sum_j w_j |s - s_j| + 2/3 w l."""
    two = np.float32(2)
    far_weight, far_moment = all_weight - near_weight - w, all_moment - near_moment - w * middle
    spread = two * (middle * near_weight - near_moment + far_moment - middle * far_weight) + two / np.float32(3) * w * length
    return g0 * rgb[0] + g1 * rgb[1] + g2 * rgb[2] + gs * spread


@numba.njit(cache=True, parallel=True, error_model="numpy")
def composite_backward(  # type: ignore[no-untyped-def]
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
            behind = g0 * background[r, 0] + g1 * background[r, 1] + g2 * background[r, 2] - grad_opacity[r]
            # What lies behind sample n contributes `rest`: the background's share and the samples', front to back from the total.
            light = one
            rest = np.float32(0)
            at = all_weight = all_moment = np.float32(0)
            gs = grad_distortion[r]
            for n in range(first[r], first[r + 1]):
                light -= weight[n]
                all_weight += weight[n]
                all_moment += weight[n] * (at + np.float32(0.5) * length[n])
                at += length[n]
            at = near_weight = near_moment = np.float32(0)
            for n in range(first[r], first[r + 1]):
                middle = at + np.float32(0.5) * length[n]
                pull = _pull(g0, g1, g2, rgb[n], gs, weight[n], length[n], middle, near_weight, near_moment, all_weight, all_moment)
                rest += weight[n] * (grad_weight[n] + pull)
                near_weight += weight[n]
                near_moment += weight[n] * middle
                at += length[n]
            light = max(light, np.float32(0))
            rest += light * behind
            grad_background[r, 0], grad_background[r, 1], grad_background[r, 2] = light * g0, light * g1, light * g2
            before = one
            at = near_weight = near_moment = np.float32(0)
            for n in range(first[r], first[r + 1]):
                density, slope = activate_density(raw[n, 0], exponential)
                w = weight[n]
                middle = at + np.float32(0.5) * length[n]
                own = grad_weight[n] + _pull(g0, g1, g2, rgb[n], gs, w, length[n], middle, near_weight, near_moment, all_weight, all_moment)
                near_weight += w
                near_moment += w * middle
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
