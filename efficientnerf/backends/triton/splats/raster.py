"""Images of projected Gaussians, and how an image's error changes with each of them, on CUDA (Triton); formulas: `efficientnerf.backends.numba.splats.raster`.

A program has a block of SIDE x SIDE pixels of a tile, and goes through the tile's Gaussians CHUNK at a time: transmittance is a product along a chunk, so
that in one warp nothing waits for another. What Gaussians gain by their pixels is added by atomics: the order of sums, and their last bits, vary.

(C, P) CHUNK Gaussians by P pixels.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import triton
import triton.language as tl

from efficientnerf.backends import layout as agreed
from efficientnerf.backends import splat_layout as layout
from efficientnerf.backends.triton.launch import INTERPRETED
from efficientnerf.backends.triton.splats.projection import ALPHA, CONIC_A, CONIC_B, CONIC_C, LEAST_ALPHA, RECORD, RED, TILE, X, Y
from efficientnerf.backends.triton.vectors import Vec3

SUMS, ERROR = tl.constexpr(layout.SUMS), tl.constexpr(layout.ERROR)
MOST_ALPHA, LEAST_TRANSMITTANCE = tl.constexpr(float(layout.MOST_ALPHA)), tl.constexpr(float(layout.LEAST_TRANSMITTANCE))
C1, C2, SIDE, WINDOW = tl.constexpr(agreed.SSIM_C1), tl.constexpr(agreed.SSIM_C2), tl.constexpr(8), tl.constexpr(agreed.SSIM_WINDOW)
CHUNK = tl.constexpr(16 if INTERPRETED else 4)
BLOCKS = (layout.TILE // SIDE.value) ** 2  # of a tile


class Pairs(NamedTuple):
    """A Gaussian in a tile each, by tiles, row by row, then from near to far."""

    begin: Any  # (T + 1,) int64: the first of each tile
    gaussian: Any  # (P,) int64
    columns: Any  # tiles along a row


class Target(NamedTuple):
    """`splat_layout.Picture`: pixels (H, W, 4) and mask (H, W) uint8, background: three floats, structure and huber_delta: floats."""

    pixels: Any
    mask: Any
    background: Any
    structure: Any
    huber_delta: Any


class Block(NamedTuple):
    """Pixels (P,) of a program: row, column, whether each is in the image, and the tile's pairs."""

    i: Any
    j: Any
    inside: Any
    first: Any
    end: Any


class Chunk(NamedTuple):
    """Gaussians of a tile at its pixels."""

    gaussian: Any  # (C,)
    colour: Any  # Vec3 (C,)
    dx: Any  # (C, P) from the mean
    dy: Any
    strength: Any  # (C, P) what it hides before that is capped
    alpha: Any
    rest: Any  # 1 - alpha; 1 where it is too faint to show
    before: Any  # transmittance before it
    after: Any  # and after it, as if no pixel ended
    counts: Any  # whether it shows before the pixel ends


@triton.jit
def _block(pairs, width, height):
    tile, part, pixel = tl.program_id(0), tl.program_id(1), tl.arange(0, SIDE * SIDE)
    i = tile // pairs.columns * TILE + part // (TILE // SIDE) * SIDE + pixel // SIDE
    j = tile % pairs.columns * TILE + part % (TILE // SIDE) * SIDE + pixel % SIDE
    return Block(i, j, (i < height) & (j < width), tl.load(pairs.begin + tile), tl.load(pairs.begin + tile + 1))


@triton.jit
def _chunk(records, pairs, block, base, through):
    """The pairs from `base` on, behind those that let `through` (P,) pass."""
    n = base + tl.arange(0, CHUNK)
    live = n < block.end
    gaussian = tl.load(pairs.gaussian + n, live, other=0)
    at = records + gaussian * RECORD
    dx = (block.j.to(tl.float32) + 0.5)[None, :] - tl.load(at + X)[:, None]
    dy = (block.i.to(tl.float32) + 0.5)[None, :] - tl.load(at + Y)[:, None]
    a, b, c = tl.load(at + CONIC_A)[:, None], tl.load(at + CONIC_B)[:, None], tl.load(at + CONIC_C)[:, None]
    q = dx * (dx * a + dy * (2 * b)) + dy * dy * c
    strength = tl.exp(-0.5 * tl.maximum(q, 0.0)) * tl.load(at + ALPHA, live, other=0.0)[:, None]
    alpha = tl.minimum(strength, MOST_ALPHA)
    shows = alpha >= LEAST_ALPHA
    rest = tl.where(shows, 1 - alpha, 1.0)
    after = through[None, :] * tl.cumprod(rest, 0)
    counts = shows & (after >= LEAST_TRANSMITTANCE)
    colour = Vec3(tl.load(at + RED), tl.load(at + RED + 1), tl.load(at + RED + 2))
    return Chunk(gaussian, colour, dx, dy, strength, alpha, rest, after / rest, after, counts)


@triton.jit
def _blend(records, pairs, block):
    """Colour (Vec3) and transmittance of a block, and where the first chunk begins that no pixel needs."""
    through = tl.where(block.inside, 1.0, 0.0)
    light = tl.zeros_like(through) + 1
    red, green, blue = tl.zeros_like(through), tl.zeros_like(through), tl.zeros_like(through)
    base = block.first
    while (base < block.end) & (tl.max(through, 0) >= LEAST_TRANSMITTANCE):
        c = _chunk(records, pairs, block, base, through)
        weight = tl.where(c.counts, c.before * c.alpha, 0.0)
        red += tl.sum(weight * c.colour.x[:, None], 0)
        green += tl.sum(weight * c.colour.y[:, None], 0)
        blue += tl.sum(weight * c.colour.z[:, None], 0)
        light = tl.minimum(light, tl.min(tl.where(c.counts, c.after, 1.0), 0))
        through = tl.min(c.after, 0)
        base += CHUNK
    return Vec3(red, green, blue), light, base


@triton.jit(do_not_specialize=["width", "height"])
def render_tiles(records, pairs, colour, transmittance, width, height):
    """Colour (H, W, 3) and transmittance (H, W)."""
    block = _block(pairs, width, height)
    found, light, _ = _blend(records, pairs, block)
    at = block.i * width + block.j
    tl.store(colour + 3 * at, found.x, block.inside)
    tl.store(colour + 3 * at + 1, found.y, block.inside)
    tl.store(colour + 3 * at + 2, found.z, block.inside)
    tl.store(transmittance + at, light, block.inside)


@triton.jit
def _slope(found, light, at, counts, picture, CHANNEL: tl.constexpr, OVER_ALL: tl.constexpr):
    """Half of the squared error's derivative by a channel, what that adds to the one by the transmittance, the error, and the colour wanted, over grey or the
    background."""
    wanted = tl.load(picture.pixels + 4 * at + CHANNEL, counts, other=0).to(tl.float32) * (1 / 255)
    if OVER_ALL:
        alpha = tl.load(picture.pixels + 4 * at + 3, counts, other=255).to(tl.float32) * (1 / 255)
        more = light - (1 - alpha)
        slope = tl.where(counts, found - wanted * alpha + 0.5 * more, 0.0)
        spread = tl.where(counts, more * (1 / 12), 0.0)
        return slope, 0.5 * slope + spread, slope * slope + more * spread, wanted * alpha + 0.5 * (1 - alpha)
    else:
        slope = tl.where(counts, found + light * picture.background[CHANNEL] - wanted, 0.0)
        return slope, slope * picture.background[CHANNEL], slope * slope, wanted


@triton.jit
def _window_mean(x):
    """The mean over each pixel's window."""
    windows = tl.reshape(x, (SIDE // WINDOW, WINDOW, SIDE // WINDOW, WINDOW))
    mean = tl.sum(tl.sum(windows, 3, keep_dims=True), 1, keep_dims=True) / (WINDOW * WINDOW)
    return tl.reshape(tl.broadcast_to(mean, (SIDE // WINDOW, WINDOW, SIDE // WINDOW, WINDOW)), (SIDE * SIDE,))


@triton.jit
def _structure_slope(difference, y, whole, weight):
    """Half of the derivative of structural dissimilarity by a channel of pixels whose window is `whole`: `efficientnerf.backends.structure`, which Triton's
    interpreter cannot read there."""
    x = y + difference
    of_x, of_y = _window_mean(x), _window_mean(y)
    x, y = x - of_x, y - of_y
    means, deviations = of_x * of_x + of_y * of_y + C1, _window_mean(x * x + y * y) + C2
    same_mean, together = (2 * of_x * of_y + C1) / means, (2 * _window_mean(x * y) + C2) / deviations
    change = (y - x * together) * (same_mean / deviations) + (of_y - of_x * same_mean) * (together / means)
    return tl.where(whole, -weight * change, 0.0)


@triton.jit
def _with_structure(slope, by_light, wanted, weight, whole, picture, CHANNEL: tl.constexpr, OVER_ALL: tl.constexpr):
    """Derivatives of the loss by a channel and by the transmittance, of what `_slope` found; weight: the loss's, of the pixels."""
    change = _structure_slope(slope, wanted, whole, picture.structure)
    if OVER_ALL:
        return slope * weight + change, by_light * weight + 0.5 * change
    else:
        return slope * weight + change, by_light * weight + change * picture.background[CHANNEL]


@triton.jit
def _pull(c, by, error, sums, v):
    """Add the sums of a chunk to its Gaussians'; v: derivatives by -q / 2."""
    weight, to, vx, vy = tl.where(c.counts, c.before * c.alpha, 0.0), sums + c.gaussian * SUMS, v * c.dx, v * c.dy
    met = tl.max(c.counts.to(tl.int32), 1) > 0
    tl.atomic_add(to, tl.sum(v, 1), met, "relaxed")
    tl.atomic_add(to + 1, tl.sum(vx, 1), met, "relaxed")
    tl.atomic_add(to + 2, tl.sum(vy, 1), met, "relaxed")
    tl.atomic_add(to + 3, tl.sum(vx * c.dx, 1), met, "relaxed")
    tl.atomic_add(to + 4, tl.sum(vx * c.dy, 1), met, "relaxed")
    tl.atomic_add(to + 5, tl.sum(vy * c.dy, 1), met, "relaxed")
    tl.atomic_add(to + 6, tl.sum(weight * by.x[None, :], 1), met, "relaxed")
    tl.atomic_add(to + 7, tl.sum(weight * by.y[None, :], 1), met, "relaxed")
    tl.atomic_add(to + 8, tl.sum(weight * by.z[None, :], 1), met, "relaxed")
    tl.atomic_add(to + ERROR, tl.sum(weight * error[None, :], 1), met, "relaxed")


@triton.jit(do_not_specialize=["width", "height"])
def fit_tiles(records, pairs, picture, sums, width, height, OVER_ALL: tl.constexpr):
    """Sums of the loss's derivatives added to `sums` (N, SUMS)."""
    block = _block(pairs, width, height)
    found, light, last = _blend(records, pairs, block)
    at = block.i * width + block.j
    counts = block.inside & (tl.load(picture.mask + at, block.inside, other=0) != 0)
    whole = _window_mean(counts.to(tl.float32)) > 0.99
    by_red, light_red, red_error, red = _slope(found.x, light, at, counts, picture, 0, OVER_ALL)
    by_green, light_green, green_error, green = _slope(found.y, light, at, counts, picture, 1, OVER_ALL)
    by_blue, light_blue, blue_error, blue = _slope(found.z, light, at, counts, picture, 2, OVER_ALL)
    error = red_error + green_error + blue_error
    weight = 1 / tl.sqrt(1 + error / (picture.huber_delta * picture.huber_delta))
    by_red, light_red = _with_structure(by_red, light_red, red, weight, whole, picture, 0, OVER_ALL)
    by_green, light_green = _with_structure(by_green, light_green, green, weight, whole, picture, 1, OVER_ALL)
    by_blue, light_blue = _with_structure(by_blue, light_blue, blue, weight, whole, picture, 2, OVER_ALL)
    behind = found.x * by_red + found.y * by_green + found.z * by_blue + light * (light_red + light_green + light_blue)
    through = tl.where(block.inside, 1.0, 0.0)
    base = block.first
    while base < last:
        c = _chunk(records, pairs, block, base, through)
        if tl.max(tl.max(c.counts.to(tl.int32), 1), 0) > 0:
            gain = by_red[None, :] * c.colour.x[:, None] + by_green[None, :] * c.colour.y[:, None] + by_blue[None, :] * c.colour.z[:, None]
            passed = tl.where(c.counts, c.before * c.alpha, 0.0) * gain
            v = (c.before * gain - (behind[None, :] - tl.cumsum(passed, 0)) / c.rest) * c.alpha
            _pull(c, Vec3(by_red, by_green, by_blue), error, sums, tl.where(c.counts & (c.strength < MOST_ALPHA), v, 0.0))
            behind -= tl.sum(passed, 0)
        through = tl.min(c.after, 0)
        base += CHUNK
