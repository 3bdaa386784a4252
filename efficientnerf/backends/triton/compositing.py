"""Compositing on CUDA (Triton), forward and backward: one program a ray, 32 of its samples at a time.

The sums along a ray are scans over the samples of a chunk, with what came before carried from chunk to chunk. The harmonics become colours here, so
that coefficients are read once and no array of N x 3 x K is made. Samples beyond the last offset (the padding of a bundle with a fixed capacity)
get no weight and no gradient.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from efficientnerf.backends.triton.vectors import sigmoid
from efficientnerf.rendering.compositing import LARGEST_LOGIT, Composite

CHUNK = 32
# Optical depth beyond which a sample is as good as opaque (e^-25 = 1e-11). Capped so that a sum over the chunk minus a sample's own part still holds
# what lies before it: a density may be as large as e^15.
OPAQUE = tl.constexpr(25.0)
LARGEST = tl.constexpr(LARGEST_LOGIT)


@triton.jit
def _activate(x, EXPONENTIAL: tl.constexpr):
    """Density and its derivative; see `efficientnerf.rendering.compositing.activate`."""
    if EXPONENTIAL:
        density = tl.exp(tl.minimum(x, LARGEST))
        slope = tl.where(x > LARGEST, 0.0, density)
    else:
        z = x - 1
        e = tl.exp(-tl.abs(z))
        density = tl.maximum(z, 0.0) + tl.log(1 + e)
        slope = tl.where(z >= 0, 1.0, e) / (1 + e)
    return density, slope


@triton.jit
def _forward(
    raw, length, first, harmonics, background, colour, opacity, distortion, weight, rgb,
    K: tl.constexpr, KP: tl.constexpr, EXPONENTIAL: tl.constexpr, CHUNK: tl.constexpr,
):  # fmt: skip
    WIDTH: tl.constexpr = 1 + 3 * K
    r = tl.program_id(0).to(tl.int64)
    base = tl.load(first + r)
    end = tl.load(first + r + 1)
    k = tl.arange(0, KP)
    basis = tl.load(harmonics + r * K + k, k < K, other=0.0)
    depth_before = 0.0  # optical depth of the chunks before
    length_before = 0.0  # length of the chunks before
    weight_before_chunk = 0.0
    moment_before_chunk = 0.0
    ray_distortion = 0.0
    red = 0.0
    green = 0.0
    blue = 0.0
    while base < end:
        n = base + tl.arange(0, CHUNK)
        live = n < end
        size = tl.load(length + n, live, other=0.0)
        density, _ = _activate(tl.load(raw + n * WIDTH, live, other=0.0), EXPONENTIAL)
        depth = tl.where(live, tl.minimum(density * size, OPAQUE), 0.0)
        w = tl.exp(-(depth_before + tl.cumsum(depth, 0) - depth)) * (1 - tl.exp(-depth))
        coefficients = raw + n[:, None] * WIDTH + 1 + k[None, :]
        stored = live[:, None] & (k < K)[None, :]
        cr = sigmoid(tl.sum(tl.load(coefficients, stored, other=0.0) * basis[None, :], 1))
        cg = sigmoid(tl.sum(tl.load(coefficients + K, stored, other=0.0) * basis[None, :], 1))
        cb = sigmoid(tl.sum(tl.load(coefficients + 2 * K, stored, other=0.0) * basis[None, :], 1))
        tl.store(weight + n, w, live)
        tl.store(rgb + n * 3, cr, live)
        tl.store(rgb + n * 3 + 1, cg, live)
        tl.store(rgb + n * 3 + 2, cb, live)
        red += tl.sum(w * cr, 0)
        green += tl.sum(w * cg, 0)
        blue += tl.sum(w * cb, 0)
        middle = length_before + tl.cumsum(size, 0) - 0.5 * size
        moment = w * middle
        before_weight = weight_before_chunk + tl.cumsum(w, 0) - w
        before_moment = moment_before_chunk + tl.cumsum(moment, 0) - moment
        ray_distortion += tl.sum(2 * w * (middle * before_weight - before_moment) + w * w * size / 3, 0)
        weight_before_chunk += tl.sum(w, 0)
        moment_before_chunk += tl.sum(moment, 0)
        depth_before += tl.sum(depth, 0)
        length_before += tl.sum(size, 0)
        base += CHUNK
    transmittance = tl.exp(-depth_before)
    tl.store(colour + r * 3, red + transmittance * tl.load(background + r * 3))
    tl.store(colour + r * 3 + 1, green + transmittance * tl.load(background + r * 3 + 1))
    tl.store(colour + r * 3 + 2, blue + transmittance * tl.load(background + r * 3 + 2))
    tl.store(opacity + r, 1 - transmittance)
    tl.store(distortion + r, ray_distortion)


@triton.jit
def _totals(raw, length, weight, begin, end, WIDTH: tl.constexpr, EXPONENTIAL: tl.constexpr, CHUNK: tl.constexpr):
    """Of a ray: optical depth, length, weight and moment of all its samples, and where the chunk after the last one begins."""
    total_depth = 0.0
    total_length = 0.0
    total_weight = 0.0
    total_moment = 0.0
    base = begin
    while base < end:
        n = base + tl.arange(0, CHUNK)
        live = n < end
        size = tl.load(length + n, live, other=0.0)
        w = tl.load(weight + n, live, other=0.0)
        density, _ = _activate(tl.load(raw + n * WIDTH, live, other=0.0), EXPONENTIAL)
        total_depth += tl.sum(tl.where(live, tl.minimum(density * size, OPAQUE), 0.0), 0)
        total_weight += tl.sum(w, 0)
        total_moment += tl.sum(w * (total_length + tl.cumsum(size, 0) - 0.5 * size), 0)
        total_length += tl.sum(size, 0)
        base += CHUNK
    return total_depth, total_length, total_weight, total_moment, base


@triton.jit
def _backward(
    raw, length, first, harmonics, background, weight, rgb, grads, grad_raw, grad_background,
    K: tl.constexpr, KP: tl.constexpr, EXPONENTIAL: tl.constexpr, CHUNK: tl.constexpr,
):  # fmt: skip
    """From `grads`, by colour, opacity, distortion and weight. Chunks from the last to the first: no small difference of large numbers is taken."""
    WIDTH: tl.constexpr = 1 + 3 * K
    r = tl.program_id(0).to(tl.int64)
    begin = tl.load(first + r)
    end = tl.load(first + r + 1)
    depth_before, length_before, total_weight, total_moment, base = _totals(raw, length, weight, begin, end, WIDTH, EXPONENTIAL, CHUNK)
    g_red = tl.load(grads[0] + r * 3)
    g_green = tl.load(grads[0] + r * 3 + 1)
    g_blue = tl.load(grads[0] + r * 3 + 2)
    g_distortion = tl.load(grads[2] + r)
    transmittance = tl.exp(-depth_before)
    tl.store(grad_background + r * 3, transmittance * g_red)
    tl.store(grad_background + r * 3 + 1, transmittance * g_green)
    tl.store(grad_background + r * 3 + 2, transmittance * g_blue)
    # What lies behind a sample contributes `behind_chunk`: the background, and the samples after it.
    b0 = tl.load(background + r * 3)
    b1 = tl.load(background + r * 3 + 1)
    b2 = tl.load(background + r * 3 + 2)
    behind_chunk = transmittance * (g_red * b0 + g_green * b1 + g_blue * b2 - tl.load(grads[1] + r))
    weight_after_chunk = 0.0
    moment_after_chunk = 0.0
    k = tl.arange(0, KP)
    basis = tl.load(harmonics + r * K + k, k < K, other=0.0)
    while base > begin:
        base -= CHUNK
        n = base + tl.arange(0, CHUNK)
        live = n < end
        size = tl.load(length + n, live, other=0.0)
        w = tl.load(weight + n, live, other=0.0)
        density, slope = _activate(tl.load(raw + n * WIDTH, live, other=0.0), EXPONENTIAL)
        depth = tl.where(live, tl.minimum(density * size, OPAQUE), 0.0)
        depth_before -= tl.sum(depth, 0)
        length_before -= tl.sum(size, 0)
        middle = length_before + tl.cumsum(size, 0) - 0.5 * size
        moment = w * middle
        after_weight = weight_after_chunk + tl.sum(w, 0) - tl.cumsum(w, 0)
        after_moment = moment_after_chunk + tl.sum(moment, 0) - tl.cumsum(moment, 0)
        before_weight = total_weight - after_weight - w
        before_moment = total_moment - after_moment - moment
        by_weight = 2 * (middle * (before_weight - after_weight) - before_moment + after_moment) + 2.0 / 3.0 * w * size
        cr = tl.load(rgb + n * 3, live, other=0.0)
        cg = tl.load(rgb + n * 3 + 1, live, other=0.0)
        cb = tl.load(rgb + n * 3 + 2, live, other=0.0)
        grad_own = tl.load(grads[3] + n, live, other=0.0) + g_red * cr + g_green * cg + g_blue * cb + g_distortion * by_weight
        weighted = w * grad_own
        behind = behind_chunk + tl.sum(weighted, 0) - tl.cumsum(weighted, 0)
        after = tl.exp(-(tl.maximum(depth_before, 0.0) + tl.cumsum(depth, 0)))
        tl.store(grad_raw + n * WIDTH, (after * grad_own - behind) * size * slope, live)
        coefficients = grad_raw + n[:, None] * WIDTH + 1 + k[None, :]
        stored = live[:, None] & (k < K)[None, :]
        tl.store(coefficients, (w * g_red * cr * (1 - cr))[:, None] * basis[None, :], stored)
        tl.store(coefficients + K, (w * g_green * cg * (1 - cg))[:, None] * basis[None, :], stored)
        tl.store(coefficients + 2 * K, (w * g_blue * cb * (1 - cb))[:, None] * basis[None, :], stored)
        behind_chunk += tl.sum(weighted, 0)
        weight_after_chunk += tl.sum(w, 0)
        moment_after_chunk += tl.sum(moment, 0)


def _padded(terms: int) -> int:
    return max(4, triton.next_power_of_2(terms))


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, raw: Tensor, length: Tensor, first: Tensor, harmonics: Tensor, background: Tensor, exponential: bool) -> tuple[Tensor, ...]:
        raw, length, first, harmonics, background = (t.detach().contiguous() for t in (raw, length, first, harmonics, background))
        rays, samples, terms = len(first) - 1, len(raw), harmonics.shape[1]
        colour, opacity, distortion = raw.new_empty(rays, 3), raw.new_empty(rays), raw.new_empty(rays)
        weight, rgb = raw.new_zeros(samples), raw.new_zeros(samples, 3)  # zeros: the padding belongs to no ray
        if rays:
            _forward[(rays,)](
                raw, length, first, harmonics, background, colour, opacity, distortion, weight, rgb,
                K=terms, KP=_padded(terms), EXPONENTIAL=exponential, CHUNK=CHUNK, num_warps=1,
            )  # fmt: skip
        ctx.save_for_backward(raw, length, first, harmonics, background, weight, rgb)
        ctx.exponential = exponential
        ctx.mark_non_differentiable(rgb)
        return colour, opacity, distortion, weight, rgb

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        raw, length, first, harmonics, background, weight, rgb = ctx.saved_tensors
        rays, terms = len(first) - 1, harmonics.shape[1]
        grad_raw, grad_background = torch.zeros_like(raw), torch.empty_like(background)
        if rays:
            _backward[(rays,)](
                raw, length, first, harmonics, background, weight, rgb, tuple(g.contiguous() for g in grads[:4]), grad_raw, grad_background,
                K=terms, KP=_padded(terms), EXPONENTIAL=ctx.exponential, CHUNK=CHUNK, num_warps=1,
            )  # fmt: skip
        return grad_raw, None, None, None, grad_background, None


def composite(raw: Tensor, length: Tensor, first: Tensor, harmonics: Tensor, background: Tensor, activation: str) -> Composite:
    """See `efficientnerf.rendering.compositing.composite`; differentiable in `raw` and `background`, and the samples' colours carry no gradient."""
    if activation not in ("exp", "softplus"):
        raise ValueError(f"activation {activation!r}: expected 'exp' or 'softplus'")
    return Composite(*_Composite.apply(raw, length, first, harmonics, background, activation == "exp"))
