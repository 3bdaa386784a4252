"""Synthetic occupancy and query points, for tests and table 7: exact shares, and the same for the same seed on every machine.

Clustered: solid balls and thin shells of random size, as in scenes. Each voxel's score is its distance to the nearest of them, and the voxels of lowest score
are occupied until the share is reached. Scattered: independent random voxels.
"""

from __future__ import annotations

import numpy as np

from efficientnerf.backends.numba.runtime import numba
from workflows.paper.structures.voxels import Voxels

BODIES = 24  # half of them solid, half shells
LEVELS = 1 << 16  # quantisation levels of the score
CAMERAS, WIDTH = 8, 800  # of the rays


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _score(side, centre, radius, solid, score):  # type: ignore[no-untyped-def]
    """Distance of each voxel's centre to the nearest body, from minus half the grid's side on, in 2^-15 of the side."""
    half, steps = np.float32(0.5), np.float32(LEVELS // 2)
    for i in numba.prange(side):
        least = np.empty(side, np.float32)
        for j in range(side):
            least[:] = half
            x, y = np.float32((i + 0.5) / side), np.float32((j + 0.5) / side)
            for b in range(len(radius)):
                squared = (x - centre[b, 0]) ** 2 + (y - centre[b, 1]) ** 2
                for k in range(side):
                    z = (np.float32(k) + half) / np.float32(side)
                    distance = np.sqrt(squared + (z - centre[b, 2]) ** 2) - radius[b]
                    distance = distance if solid[b] else abs(distance)
                    least[k] = min(least[k], distance)
            for k in range(side):
                score[i, j, k] = np.uint16(min(max((least[k] + half) * steps, np.float32(0)), np.float32(LEVELS - 1)))


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _histogram(score):  # type: ignore[no-untyped-def]
    counts = np.zeros((len(score), LEVELS), np.int32)
    for i in numba.prange(len(score)):
        for j in range(score.shape[1]):
            for k in range(score.shape[2]):
                counts[i, score[i, j, k]] += 1
    return counts


@numba.njit(cache=True, parallel=True, error_model="numpy")
def _select(score, counts, last, tied, coordinates, packed):  # type: ignore[no-untyped-def]
    """The voxels of score below `last`, and the first `tied` of score `last`, in row-major order."""
    side = len(score)
    begins, ties = np.zeros(side + 1, np.int64), np.zeros(side + 1, np.int64)
    for i in range(side):
        ties[i + 1] = ties[i] + counts[i, last]
        begins[i + 1] = begins[i] + counts[i, :last].sum() + min(max(tied - ties[i], 0), counts[i, last])
    for i in numba.prange(side):
        at, equal = begins[i], ties[i]
        for j in range(side):
            for k in range(side):
                if score[i, j, k] > last:
                    continue
                if score[i, j, k] == last:
                    equal += 1
                    if equal > tied:
                        continue
                coordinates[at, 0], coordinates[at, 1], coordinates[at, 2] = i, j, k
                packed[at] = _distinct_value((np.uint64(i) * np.uint64(side) + np.uint64(j)) * np.uint64(side) + np.uint64(k))
                at += 1


@numba.njit(cache=True, inline="always")
def _distinct_value(number):  # type: ignore[no-untyped-def]
    """Four half-precision values from 1 to 2, distinct for each voxel: splitmix64 of its index."""
    number = (number + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    number = (number ^ (number >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    number = (number ^ (number >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    number ^= number >> np.uint64(31)
    return (number & np.uint64(0x03FF03FF03FF03FF)) | np.uint64(0x3C003C003C003C00)


def _voxels_of_lowest_score(score: np.ndarray, share: float) -> Voxels:
    side = len(score)
    count = round(share * side**3)
    counts = _histogram(score)
    cumulative = np.cumsum(counts.sum(axis=0, dtype=np.int64))
    last = int(np.searchsorted(cumulative, count))
    below = int(cumulative[last - 1]) if last else 0
    coordinates, packed = np.empty((count, 3), np.int32), np.empty(count, np.uint64)
    _select(score, counts, last, count - below, coordinates, packed)
    return Voxels(side, coordinates, packed)


def clustered(side: int, share: float, seed: int) -> Voxels:
    """round(share * side^3) voxels in balls and shells, in row-major order."""
    rng = np.random.default_rng(seed)
    centre = rng.uniform(0.15, 0.85, (BODIES, 3)).astype(np.float32)
    radius = rng.uniform(0.03, 0.15, BODIES).astype(np.float32)
    score = np.empty((side, side, side), np.uint16)
    _score(side, centre, radius, np.arange(BODIES) % 2 == 0, score)
    return _voxels_of_lowest_score(score, share)


def scattered(side: int, share: float, seed: int) -> Voxels:
    """round(share * side^3) random voxels, in row-major order."""
    score = np.random.default_rng(seed).integers(0, LEVELS, (side, side, side), np.uint16)
    return _voxels_of_lowest_score(score, share)


def shuffled(voxels: Voxels, seed: int) -> Voxels:
    """The same voxels, listed in random order."""
    order = np.random.default_rng(seed).permutation(len(voxels.packed))
    return Voxels(voxels.side, voxels.coordinates[order], voxels.packed[order])


def random_points(side: int, count: int, seed: int) -> np.ndarray:
    """(count, 3) float32, uniform in the grid, voxel coordinates."""
    points = np.random.default_rng(seed).random((count, 3), np.float32) * np.float32(side)
    return np.minimum(points, np.nextafter(np.float32(side), np.float32(0)))


def ray_points(side: int, count: int, seed: int) -> np.ndarray:
    """At least `count` points along camera rays, ray by ray as a renderer marches them: (M, 3) float32, voxel coordinates.

    Cameras around the grid, at twice its side, point at its centre; each contributes some rows of its image of WIDTH x WIDTH pixels, spread over the height.
    A ray is sampled once per voxel length between entering and leaving the grid.
    """
    rng = np.random.default_rng(seed)
    per_row = 0.45 * WIDTH * side  # points of a row, roughly
    rows = max(round(count / CAMERAS / per_row), 1)
    parts: list[np.ndarray] = []
    total = images = 0
    while total < count:
        forward = rng.normal(size=3)
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        up = np.cross(right, forward)
        v = ((np.arange(rows) + rng.random()) / rows - 0.5) * 0.9
        u = (np.arange(WIDTH) + 0.5) / WIDTH - 0.5
        rays = (forward + 0.7 * (u[None, :, None] * right + v[:, None, None] * up)).reshape(-1, 3)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        marched = _march(side, side * (0.5 - 2 * forward), rays)
        parts.append(marched)
        total, images = total + len(marched), images + 1
        if images > 100 * CAMERAS:
            raise ValueError(f"ray_points: {total} points after {images} images of a grid of side {side}; expected {count}, use fewer")
    return np.concatenate(parts)


def _march(side: int, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Points on rays (R, 3) of unit length, one voxel apart inside the grid: (M, 3) float32."""
    inverse = 1 / np.where(np.abs(rays) < 1e-9, 1e-9, rays)
    low, high = (0 - origin) * inverse, (side - origin) * inverse
    enter = np.minimum(low, high).max(axis=1)
    leave = np.maximum(low, high).min(axis=1)
    steps = np.maximum(np.floor(leave - enter), 0).astype(np.int64)
    ray = np.repeat(np.arange(len(rays)), steps)
    step = np.arange(len(ray)) - np.repeat(np.cumsum(steps) - steps, steps)
    points = origin + (enter[ray] + step + 0.5)[:, None] * rays[ray]
    return np.clip(points.astype(np.float32), 0, np.nextafter(np.float32(side), np.float32(0)))
