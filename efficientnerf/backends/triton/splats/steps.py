"""Steps of Gaussians down the error of an image on CUDA (Triton), a lane each: back through the projection, then Adam, in one kernel; formulas and what
counts as constant: `efficientnerf.backends.numba.splats.fitting`."""

from __future__ import annotations

from typing import Any, NamedTuple

import triton
import triton.language as tl

from efficientnerf.backends import splat_layout as layout
from efficientnerf.backends.triton.harmonics import harmonic
from efficientnerf.backends.triton.splats.projection import HARMONICS, MEAN, OPACITY, ROTATION, SCALE, colour_of, conic_of, image_of
from efficientnerf.backends.triton.splats.raster import ERROR, SUMS
from efficientnerf.backends.triton.vectors import Vec3, sigmoid

SQUARES, GRADIENTS = tl.constexpr(layout.SQUARES), tl.constexpr(layout.GRADIENTS)
DRAWS, LANES = tl.constexpr(layout.DRAWS), tl.constexpr(layout.LANES)


class Rule(NamedTuple):
    """Numbers of `splat_layout.Rates`; rates: a tuple."""

    rates: Any
    momentum: Any
    decay: Any
    epsilon: Any
    fade: Any
    noise: Any
    least: Any
    greatest: Any


class Walk(NamedTuple):
    """Gaussians that take a step."""

    value: Any  # pointers to what each has in its first row; tuples of Triton have values of their own
    moment: Any
    count: Any  # of all
    moves: Any  # (B,) whether each moves
    ahead: Any  # (B,) factor of its rates
    correction: Any  # (B,) of its running means of squares
    rule: Any


@triton.jit
def _scale(walk, PART: tl.constexpr, square, rate):
    """What running means of gradients are multiplied by, with the mean `square` of those of a part taken in."""
    at = walk.moment + walk.count * (SQUARES + PART)
    mean = tl.load(at, walk.moves, other=0.0) * walk.rule.decay + square * (1 - walk.rule.decay)
    tl.store(at, mean, walk.moves)
    return walk.ahead * rate / (tl.sqrt(mean * walk.correction) + walk.rule.epsilon)


@triton.jit
def _descend(walk, row, gradient, scale):
    """The step of a row; returns its values."""
    at, to = walk.moment + walk.count * (GRADIENTS + row), walk.value + walk.count * row
    mean = tl.load(at, walk.moves, other=0.0) * walk.rule.momentum + gradient * (1 - walk.rule.momentum)
    value = tl.load(to, walk.moves, other=0.0) - scale * mean
    tl.store(at, mean, walk.moves)
    tl.store(to, value, walk.moves)
    return value


@triton.jit
def _descend_three(walk, row, PART: tl.constexpr, g, rate):
    """The step of a part of three rows, with gradients g (Vec3)."""
    scale = _scale(walk, PART, (g.x * g.x + g.y * g.y + g.z * g.z) / 3, rate)
    return Vec3(_descend(walk, row, g.x, scale), _descend(walk, row + 1, g.y, scale), _descend(walk, row + 2, g.z, scale))


@triton.jit
def _by_covariance(conic, sums):
    """Derivatives by the root of the covariance in the image, its two rows (Vec3): half of Q V Q, Q the conic, twice, times the root."""
    a, b, c = conic.a, conic.b, conic.c
    vxx, vxy, vyy = sums
    qx, qy, rx, ry = a * vxx + b * vxy, a * vxy + b * vyy, b * vxx + c * vxy, b * vxy + c * vyy
    hxx, hxy, hyy = qx * a + qy * b, qx * b + qy * c, rx * b + ry * c
    dx = Vec3(hxx * conic.ax.x + hxy * conic.ay.x, hxx * conic.ax.y + hxy * conic.ay.y, hxx * conic.ax.z + hxy * conic.ay.z)
    dy = Vec3(hxy * conic.ax.x + hyy * conic.ay.x, hxy * conic.ax.y + hyy * conic.ay.y, hxy * conic.ax.z + hyy * conic.ay.z)
    return dx, dy


@triton.jit
def _turn(walk, p, dx, dy):
    """The step of the quaternions, by derivatives of the covariance's root."""
    wx, wy, s = p.by_x, p.by_y, p.scales
    g00, g01, g02 = (wx.x * dx.x + wy.x * dy.x) * s.x, (wx.x * dx.y + wy.x * dy.y) * s.y, (wx.x * dx.z + wy.x * dy.z) * s.z
    g10, g11, g12 = (wx.y * dx.x + wy.y * dy.x) * s.x, (wx.y * dx.y + wy.y * dy.y) * s.y, (wx.y * dx.z + wy.y * dy.z) * s.z
    g20, g21, g22 = (wx.z * dx.x + wy.z * dy.x) * s.x, (wx.z * dx.y + wy.z * dy.y) * s.y, (wx.z * dx.z + wy.z * dy.z) * s.z
    w, x, y, z = p.quaternion
    by_w = 2 * (y * (g02 - g20) + z * (g10 - g01) + x * (g21 - g12))
    by_x = 2 * (y * (g01 + g10) + z * (g02 + g20) + w * (g21 - g12) - 2 * x * (g11 + g22))
    by_y = 2 * (x * (g01 + g10) + z * (g12 + g21) + w * (g02 - g20) - 2 * y * (g00 + g22))
    by_z = 2 * (x * (g02 + g20) + y * (g12 + g21) + w * (g10 - g01) - 2 * z * (g00 + g11))
    along = by_w * w + by_x * x + by_y * y + by_z * z
    by_w, by_x, by_y, by_z = (by_w - along * w) / p.length, (by_x - along * x) / p.length, (by_y - along * y) / p.length, (by_z - along * z) / p.length
    scale = _scale(walk, 2, (by_w * by_w + by_x * by_x + by_y * by_y + by_z * by_z) / 4, walk.rule.rates[2])
    _descend(walk, ROTATION, by_w, scale)
    _descend(walk, ROTATION + 1, by_x, scale)
    _descend(walk, ROTATION + 2, by_y, scale)
    _descend(walk, ROTATION + 3, by_z, scale)


@triton.jit
def _colour(walk, view, g, K: tl.constexpr):
    """The step of the harmonics, with gradients g (Vec3) by the colours, none by one that is clipped."""
    base = harmonic(view, 0)
    _descend_three(walk, HARMONICS, 4, Vec3(base * g.x, base * g.y, base * g.z), walk.rule.rates[4])
    if K > 1:
        squares = tl.zeros_like(base)
        for k in tl.static_range(1, K):
            basis = harmonic(view, k)
            squares += basis * basis
        scale = _scale(walk, 5, squares * (g.x * g.x + g.y * g.y + g.z * g.z) / (3 * K - 3), walk.rule.rates[5])
        for k in tl.static_range(1, K):
            basis = harmonic(view, k)
            _descend(walk, HARMONICS + 3 * k, basis * g.x, scale)
            _descend(walk, HARMONICS + 3 * k + 1, basis * g.y, scale)
            _descend(walk, HARMONICS + 3 * k + 2, basis * g.z, scale)


@triton.jit(do_not_specialize=["count", "shift"])
def step(
    values, moments, errors, sums, tiles, count, lens, rule, draws, shift, FISHEYE: tl.constexpr, K: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    """A step of the Gaussians that are in tiles, and their part in the error added to `errors` (N,); sums (N, SUMS) are of `raster.fit_tiles`, draws and shift
    of `splat_layout.Rates`."""
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    moves = (n < count) & (tl.load(tiles + n, n < count, other=0) > 0)
    visits = tl.load(moments + n, moves, other=0.0) + 1
    tl.store(moments + n, visits, moves)
    ahead, correction = 1 / (1 - tl.exp(visits * tl.log(rule.momentum))), 1 / (1 - tl.exp(visits * tl.log(rule.decay)))
    walk = Walk(values + n, moments + n, count, moves, ahead, correction, rule)
    at = sums + n * SUMS
    v, vx, vy = tl.load(at, moves, other=0.0), tl.load(at + 1, moves, other=0.0), tl.load(at + 2, moves, other=0.0)
    second = tl.load(at + 3, moves, other=0.0), tl.load(at + 4, moves, other=0.0), tl.load(at + 5, moves, other=0.0)
    tl.store(errors + n, tl.load(errors + n, moves, other=0.0) + tl.load(at + ERROR, moves, other=0.0), moves)
    p = image_of(values, n, count, moves, lens, FISHEYE)
    conic = conic_of(p)
    view, colour = colour_of(values, n, count, moves, lens, K)
    opacity = tl.load(values + count * OPACITY + n, moves, other=0.0)
    px, py = conic.a * vx + conic.b * vy, conic.b * vx + conic.c * vy
    by_mean = Vec3(px * p.by_x.x + py * p.by_y.x, px * p.by_x.y + py * p.by_y.y, px * p.by_x.z + py * p.by_y.z)
    longest = tl.maximum(p.scales.x, tl.maximum(p.scales.y, p.scales.z))
    mean = _descend_three(walk, MEAN, 0, by_mean, longest * rule.rates[0])
    drawn = draws + (shift + n // LANES * (3 * LANES)) % DRAWS + n % LANES
    far = longest * rule.noise
    tl.store(walk.value + count * MEAN, mean.x + far * tl.load(drawn), moves)
    tl.store(walk.value + count * (MEAN + 1), mean.y + far * tl.load(drawn + LANES), moves)
    tl.store(walk.value + count * (MEAN + 2), mean.z + far * tl.load(drawn + 2 * LANES), moves)
    dx, dy = _by_covariance(conic, second)
    ax, ay = conic.ax, conic.ay
    by_scales = Vec3(dx.x * ax.x + dy.x * ay.x, dx.y * ax.y + dy.y * ay.y, dx.z * ax.z + dy.z * ay.z)
    scales = _descend_three(walk, SCALE, 1, by_scales, rule.rates[1])
    tl.store(walk.value + count * SCALE, tl.minimum(tl.maximum(scales.x, rule.least), rule.greatest), moves)
    tl.store(walk.value + count * (SCALE + 1), tl.minimum(tl.maximum(scales.y, rule.least), rule.greatest), moves)
    tl.store(walk.value + count * (SCALE + 2), tl.minimum(tl.maximum(scales.z, rule.least), rule.greatest), moves)
    _turn(walk, p, dx, dy)
    by_logit = v * (1 - sigmoid(opacity))
    logit = _descend(walk, OPACITY, by_logit, _scale(walk, 3, by_logit * by_logit, rule.rates[3]))
    tl.store(walk.value + count * OPACITY, logit - rule.fade, moves)
    red, green, blue = tl.load(at + 6, moves, other=0.0), tl.load(at + 7, moves, other=0.0), tl.load(at + 8, moves, other=0.0)
    _colour(walk, view, Vec3(tl.where(colour.x > 0, red, 0.0), tl.where(colour.y > 0, green, 0.0), tl.where(colour.z > 0, blue, 0.0)), K)
