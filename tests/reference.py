"""The method's sums as slow loops over plain numbers (float64), one ray, sample or voxel at a time: what the fast code is measured against.

Written from the paper and from FORMAT.md, not from the code: nothing here imports the package.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

FARTHEST = 64.0  # |u|_inf at which a ray in contracted space ends
LARGEST_LOGIT = 15.0


def legendre(l: int, m: int, x: float) -> float:
    """Associated Legendre polynomial P_l^m, m >= 0, with the Condon-Shortley phase, by the usual recurrence in l."""
    value = 1.0
    for odd in range(1, 2 * m, 2):
        value *= -odd * math.sqrt(max(0.0, 1 - x * x))
    before, degree = 0.0, m
    while degree < l:
        before, value = value, ((2 * degree + 1) * x * value - (degree + m) * before) / (degree - m + 1)
        degree += 1
    return value


def harmonics(direction: Sequence[float], degree: int) -> list[float]:
    """Real spherical harmonics by their definition, ordered l = 0, m = 0; l = 1, m = -1, 0, 1; ..."""
    x, y, z = direction
    azimuth = math.atan2(y, x)
    out = []
    for l in range(degree + 1):
        for m in range(-l, l + 1):
            scale = math.sqrt((2 * l + 1) / (4 * math.pi) * math.factorial(l - abs(m)) / math.factorial(l + abs(m)))
            if m:
                scale *= math.sqrt(2) * (math.cos(m * azimuth) if m > 0 else math.sin(-m * azimuth))
            out.append(scale * legendre(l, abs(m), z))
    return out


def sigmoid(x: float) -> float:
    return 1 / (1 + math.exp(-x)) if x >= 0 else math.exp(x) / (1 + math.exp(x))


def activate(raw: float, activation: str) -> float:
    if activation == "exp":
        return math.exp(min(raw, LARGEST_LOGIT))
    return max(raw - 1, 0.0) + math.log1p(math.exp(-abs(raw - 1)))


class Pixel(NamedTuple):
    colour: list[float]
    opacity: float
    weights: list[float]


def composite(density: Sequence[float], length: Sequence[float], rgb: Sequence[Sequence[float]], background: Sequence[float]) -> Pixel:
    """One ray: EfficientNeRF, equations 1 to 3, and the background behind what is left of the light."""
    light, colour, weights = 1.0, [0.0, 0.0, 0.0], []
    for sigma, extent, sample in zip(density, length, rgb, strict=True):
        alpha = 1 - math.exp(-sigma * extent)
        weights.append(light * alpha)
        colour = [c + weights[-1] * s for c, s in zip(colour, sample, strict=True)]
        light *= 1 - alpha
    return Pixel([c + light * b for c, b in zip(colour, background, strict=True)], 1 - light, weights)


def distortion(weights: Sequence[float], length: Sequence[float]) -> float:
    """How far one ray's weights are spread (Barron et al. 2022, "Mip-NeRF 360", equation 15), along the running sum of its lengths."""
    middle = [sum(length[:n]) + length[n] / 2 for n in range(len(length))]
    pairs = sum(a * b * abs(s - t) for a, s in zip(weights, middle, strict=True) for b, t in zip(weights, middle, strict=True))
    return pairs + sum(w * w * extent for w, extent in zip(weights, length, strict=True)) / 3


def momentum(values: Sequence[float], cells: Sequence[int], densities: Sequence[float], beta: float) -> list[float]:
    """Equation 7; the samples of one step in one voxel make one update, by their mean."""
    out = list(values)
    for voxel in range(len(out)):
        seen = [density for cell, density in zip(cells, densities, strict=True) if cell == voxel]
        if seen:
            out[voxel] = (1 - beta) * out[voxel] + beta * sum(seen) / len(seen)
    return out


def maximum(values: Sequence[float], cells: Sequence[int], densities: Sequence[float]) -> list[float]:
    """Voxels raised to the densities of samples in them; masked ones, which hold minus infinity, stay so."""
    return [old if old == -math.inf else max([old, *(d for c, d in zip(cells, densities, strict=True) if c == voxel)]) for voxel, old in enumerate(values)]


def adam(value: float, gradients: Sequence[float], rates: Sequence[float], beta1: float, beta2: float, epsilon: float, *, skip_zeros: bool = False) -> float:
    """Kingma and Ba's algorithm 1 on one number; with `skip_zeros`, steps without a gradient leave it and its moments alone."""
    first = second = 0.0
    for step, (gradient, rate) in enumerate(zip(gradients, rates, strict=True), 1):
        if skip_zeros and gradient == 0:
            continue
        first = beta1 * first + (1 - beta1) * gradient
        second = beta2 * second + (1 - beta2) * gradient**2
        value -= rate * (first / (1 - beta1**step)) / (math.sqrt(second / (1 - beta2**step)) + epsilon)
    return value


def encode(point: Sequence[float], table: np.ndarray, sides: Sequence[int], dense: Sequence[bool], starts: Sequence[int], size: int) -> list[float]:
    """Features of one point in a multiresolution hash grid (Mueller et al. 2022, sections 3 and 3.1); tables of `size` entries."""
    features = []
    for side, flat, start in zip(sides, dense, starts, strict=True):
        at = [min(max(x, 0.0), 1.0) * (side - 1) for x in point]
        low = [min(int(x), side - 2) for x in at]
        total = [0.0] * table.shape[1]
        for corner in np.ndindex(2, 2, 2):
            place = [i + c for i, c in zip(low, corner, strict=True)]
            weight = math.prod((x - i) if c else 1 - (x - i) for x, i, c in zip(at, low, corner, strict=True))
            if flat:
                slot = (place[0] * side + place[1]) * side + place[2]
            else:
                slot = (place[0] ^ (place[1] * 2654435761) % 2**32 ^ (place[2] * 805459861) % 2**32) % size
            total = [t + weight * float(v) for t, v in zip(total, table[start + slot], strict=True)]
        features += total
    return features


def relu_network(features: Sequence[float], weights: Sequence[np.ndarray], offset: float) -> list[float]:
    """Outputs of one point: linear layers (O, I) with a ReLU between them; `offset` is added to the first output."""
    x = list(features)
    for layer, weight in enumerate(weights):
        x = [sum(float(w) * v for w, v in zip(row, x, strict=True)) for row in weight]
        if layer < len(weights) - 1:
            x = [max(v, 0.0) for v in x]
    return [x[0] + offset, *x[1:]]


def pixel_direction(lookup: np.ndarray, begin: int, knots: int, stride: int, pixel: int, width: int, rotation: np.ndarray) -> np.ndarray:
    """Unit direction in the world of a pixel, bilinearly interpolated between those of knots `stride` pixels apart."""
    (row, f), (column, g) = (divmod(i, stride) for i in divmod(pixel, width))
    total = np.zeros(3)
    for down, right in np.ndindex(2, 2):
        weight = (f / stride if down else 1 - f / stride) * (g / stride if right else 1 - g / stride)
        if weight > 0:
            total += weight * lookup[begin + (row + down) * knots + column + right]
    return rotation @ (total / math.sqrt(total @ total))


def contract(u: Sequence[float]) -> list[float]:
    far = max(abs(x) for x in u)
    return list(u) if far <= 1 else [(2 - 1 / far) / far * x for x in u]


class March(NamedTuple):
    """samples  (start, extent, length, grid point) of each valid one; tried intervals; margin: how near any decision was to falling otherwise."""

    samples: list[tuple[float, float, float, list[float]]]
    tried: int
    margin: float


def march(
    bounds: np.ndarray, contracted: bool, origin: Sequence[float], direction: Sequence[float], near: float, far: float, offset: float,
    step: float, max_intervals: int, voxels: np.ndarray, threshold: float,
) -> March:  # fmt: skip
    """The valid samples of one ray, interval by interval (equation 9)."""
    centre, half = (bounds[0] + bounds[1]) / 2, (bounds[1] - bounds[0]) / 2
    side, reach_of_grid = voxels.shape[0], 2.0 if contracted else 1.0

    def unit(t: float) -> list[float]:
        return [(origin[n] + t * direction[n] - centre[n]) / half[n] for n in range(3)]

    enter, leave, margin = near, far, math.inf
    if not contracted:
        for n in range(3):
            u = (origin[n] - centre[n]) / half[n]
            if direction[n] == 0:
                if not -1 <= u <= 1:
                    return March([], 0, abs(abs(u) - 1))
                continue
            crossings = sorted(((-1 - u) * half[n] / direction[n], (1 - u) * half[n] / direction[n]))
            enter, leave = max(enter, crossings[0]), min(leave, crossings[1])
        margin = abs(leave - enter)
    t, samples, tried = enter, [], 0
    for _ in range(max_intervals):
        margin = min(margin, abs(t - leave))
        stretch = 1.0
        if contracted:
            reach = max(1.0, *(abs(x) for x in unit(t)))
            margin = min(margin, abs(reach - FARTHEST))
            if reach > FARTHEST:
                break
            stretch = reach**2
        if t >= leave:
            break
        extent = min(step * stretch, leave - t)
        u = unit(t + offset * extent)
        point = [(x + reach_of_grid) / (2 * reach_of_grid) for x in (contract(u) if contracted else u)]
        tried += 1
        cell = tuple(min(max(math.floor(x * side), 0), side - 1) for x in point)
        margin = min(margin, *(abs(x * side - round(x * side)) if 0 < round(x * side) < side else math.inf for x in point))
        if voxels[cell] > threshold:
            samples.append((t, extent, extent / stretch, point))
        t += step * stretch
    return March(samples, tried, margin)


def select_pivots(weights: Sequence[float], threshold: float, max_pivots: int) -> list[bool]:
    """One ray: samples of a weight above the threshold, at most so many, the heaviest; among equals the nearer."""
    heaviest = sorted(range(len(weights)), key=lambda n: (-weights[n], n))[:max_pivots]
    return [n in heaviest and weight > threshold for n, weight in enumerate(weights)]


def pivotal_samples(
    bounds: np.ndarray, contracted: bool, origin: Sequence[float], direction: Sequence[float], offset: float,
    intervals: Sequence[tuple[float, float, float]], per_pivot: int,
) -> list[tuple[float, float, float, list[float]]]:  # fmt: skip
    """(start, extent, length, grid point) of one ray's fine samples: its pivotal intervals (start, extent, length), cut into equal slots."""
    centre, half = (bounds[0] + bounds[1]) / 2, (bounds[1] - bounds[0]) / 2
    reach, found = 2.0 if contracted else 1.0, []
    for start, extent, length in intervals:
        for slot in range(per_pivot):
            begin = start + slot * extent / per_pivot
            t = begin + offset * extent / per_pivot
            u = [(origin[n] + t * direction[n] - centre[n]) / half[n] for n in range(3)]
            point = [(x + reach) / (2 * reach) for x in (contract(u) if contracted else u)]
            found.append((begin, extent / per_pivot, length / per_pivot, point))
    return found


# The tree, as FORMAT.md says a file is to be sampled.


def corners(tree: Any, point: np.ndarray) -> list[tuple[int, float]]:
    """The stored voxels among the eight round a point in voxel coordinates, and their trilinear weights; of the one that holds it, if so the lookup is."""
    if tree.lookup == "nearest":
        point = np.floor(point) + 0.5
    low = [math.floor(x - 0.5) for x in point]
    found = []
    for corner in np.ndindex(2, 2, 2):
        voxel = [i + c for i, c in zip(low, corner, strict=True)]
        weight = math.prod((x - 0.5 - i) if c else 1 - (x - 0.5 - i) for x, i, c in zip(point, low, corner, strict=True))
        if all(0 <= v < n * tree.brick for v, n in zip(voxel, tree.shape, strict=True)):
            owner = tree.brick_index[tuple(v // tree.brick for v in voxel)]
            x, y, z = (v % tree.brick for v in voxel)
            stored = tree.voxel_index[owner, (x * tree.brick + y) * tree.brick + z] if owner >= 0 else -1
            if stored >= 0:
                found.append((int(stored), weight))
    return found


def tree_density(tree: Any, point: np.ndarray) -> float:
    """Density at a point in voxel coordinates."""
    cell = tuple(math.floor(x / tree.brick) for x in point)
    if any(not 0 <= c < n for c, n in zip(cell, tree.shape, strict=True)) or tree.brick_index[cell] < 0:
        return 0.0
    return sum(weight * float(tree.density_values[voxel]) for voxel, weight in corners(tree, point))


def tree_colour(tree: Any, point: np.ndarray, basis: Sequence[float]) -> list[float]:
    """Colour at a point in voxel coordinates for the harmonics `basis`; grey where nothing is stored."""
    found = corners(tree, point)
    total = sum(weight for _, weight in found)
    if total <= 0:
        return [0.5, 0.5, 0.5]
    return [sigmoid(sum(w * sum(y * float(tree.sh[v, k, c]) for k, y in enumerate(basis)) for v, w in found) / total) for c in range(3)]


def tree_ray(tree: Any, origin: np.ndarray, direction: np.ndarray) -> tuple[list[float], float, float]:
    """Premultiplied colour, opacity and depth (distance at which half of the light is gone, or infinity) of one ray."""
    start = (np.asarray(origin, np.float64) - tree.bounds_min) / tree.voxel
    enter, leave = 0.0, math.inf
    for n in range(3):
        if direction[n] == 0:
            if not 0 <= start[n] <= tree.shape[n] * tree.brick:
                return [0.0, 0.0, 0.0], 0.0, math.inf
            continue
        crossings = sorted((-start[n] / direction[n], (tree.shape[n] * tree.brick - start[n]) / direction[n]))
        enter, leave = max(enter, crossings[0]), min(leave, crossings[1])
    basis = harmonics(direction, tree.degree)
    light, colour, depth, k = 1.0, [0.0, 0.0, 0.0], math.inf, 0
    while (t := enter + (k + 0.5) * tree.step_size) < leave:
        point = start + t * np.asarray(direction)
        sigma = tree_density(tree, point)
        if sigma > 0:
            alpha = 1 - math.exp(-sigma * tree.step_size * tree.voxel)
            colour = [c + light * alpha * s for c, s in zip(colour, tree_colour(tree, point, basis), strict=True)]
            if math.isinf(depth) and light * (1 - alpha) <= 0.5:
                depth = (t - tree.step_size / 2) * tree.voxel + math.log(2 * light) / sigma
            light *= 1 - alpha
        k += 1
    return colour, 1 - light, depth


def ssim(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Wang et al. 2004, equation 13, of each whole window of 11 x 11: (H - 10, W - 10, 3)."""
    offsets = np.arange(-5, 6)
    weight = np.exp(-0.5 * (offsets[:, None] ** 2 + offsets**2) / 1.5**2)
    weight /= weight.sum()
    out = np.empty((image.shape[0] - 10, image.shape[1] - 10, image.shape[2]))
    for row, column, channel in np.ndindex(out.shape):
        x, y = (a[row : row + 11, column : column + 11, channel] for a in (image, truth))
        mean_x, mean_y = (weight * x).sum(), (weight * y).sum()
        variance_x, variance_y = (weight * (x - mean_x) ** 2).sum(), (weight * (y - mean_y) ** 2).sum()
        covariance = (weight * (x - mean_x) * (y - mean_y)).sum()
        luminance = (2 * mean_x * mean_y + 0.01**2) / (mean_x**2 + mean_y**2 + 0.01**2)
        out[row, column, channel] = luminance * (2 * covariance + 0.03**2) / (variance_x + variance_y + 0.03**2)
    return out
