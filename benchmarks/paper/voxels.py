"""The occupied voxels of a cubic grid, made up for table 7, and points to query: exact shares, and the same for the same seed on every machine.

Voxel (i, j, k) is the cube [i, i + 1) x [j, j + 1) x [k, k + 1). Its four values (r, g, b, density) are half precision and packed into 64 bits, so that a
query copies bits. Zero stands for an empty voxel, as in PlenOctree, whose empty leaves have density 0; hence no voxel holds it.

Clustered: solid balls and thin shells of random size, as in scenes. Each voxel's score is its distance to the nearest of them, and the voxels of lowest score
are occupied until the share is reached. Scattered: independent random voxels.

N voxels, M points.
"""

from dataclasses import dataclass

import numpy as np

BODIES = 24  # half of them solid, half shells
LEVELS = 1 << 16  # quantisation levels of the score
CAMERAS, WIDTH = 8, 800  # of the rays


@dataclass(frozen=True, eq=False)
class Voxels:
    """A list of occupied voxels."""

    side: int  # voxels along each side of the grid
    coordinates: np.ndarray  # (N, 3) int32, each once, in any order
    packed: np.ndarray  # (N,) int64 values, none zero


def _voxels_of_lowest_score(score: np.ndarray, share: float) -> Voxels:
    """round(share * side^3) voxels, of equal scores the first, in row-major order."""
    side, count = len(score), round(share * score.size)
    reached = np.cumsum(sum(np.bincount(slab.ravel(), minlength=LEVELS) for slab in score))
    last = int(np.searchsorted(reached, count))
    chosen = score < last
    tied = np.flatnonzero(score == last)[: count - (int(reached[last - 1]) if last else 0)]
    chosen.ravel()[tied] = True
    number = np.flatnonzero(chosen)
    coordinates = np.stack(np.unravel_index(number, score.shape), axis=1).astype(np.int32)
    return Voxels(side, coordinates, _distinct_values(number.astype(np.uint64)))


def _distinct_values(number: np.ndarray) -> np.ndarray:
    """Four half-precision values from 1 to 2, distinct for each voxel: splitmix64 of its index."""
    word = (number + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB), (31, 1)):
        word = (word ^ (word >> np.uint64(shift))) * np.uint64(factor)
    return ((word & np.uint64(0x03FF03FF03FF03FF)) | np.uint64(0x3C003C003C003C00)).view(np.int64)


def clustered(side: int, share: float, seed: int) -> Voxels:
    """round(share * side^3) voxels in balls and shells, in row-major order."""
    rng = np.random.default_rng(seed)
    centres = rng.uniform(0.15, 0.85, (BODIES, 3)).astype(np.float32)
    radii = rng.uniform(0.03, 0.15, BODIES).astype(np.float32)
    along = (np.arange(side, dtype=np.float32) + np.float32(0.5)) / np.float32(side)
    score = np.empty((side, side, side), np.uint16)
    for x, slab in zip(along, score, strict=True):
        least = np.full((side, side), 0.5, np.float32)
        for body, (centre, radius) in enumerate(zip(centres, radii, strict=True)):
            across = (x - centre[0]) ** 2 + (along - centre[1]) ** 2
            distance = np.sqrt(across[:, None] + (along - centre[2]) ** 2) - radius
            np.minimum(least, distance if body % 2 == 0 else np.abs(distance), out=least)
        slab[:] = np.clip((least + np.float32(0.5)) * np.float32(LEVELS // 2), 0, LEVELS - 1)
    return _voxels_of_lowest_score(score, share)


def scattered(side: int, share: float, seed: int) -> Voxels:
    """round(share * side^3) random voxels, in row-major order."""
    score = np.random.default_rng(seed).integers(0, LEVELS, (side, side, side), np.uint16)
    return _voxels_of_lowest_score(score, share)


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
    total = 0
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
        total += len(marched)
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
