"""Square markers of known size, seen by known cameras: how long an edge is in the cameras' unit, and how sure that is.

Letters: V views, M markers, s the length of an edge, u = log s. A marker is a plane square of seven unknowns (turn, place, u), fitted to the rays through its
corners: offsets from the rays, in pixels of the middle of each picture, as in bundle adjustment.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from efficientnerf.capture.triangulation import across_rays, meeting, offsets_from_rays
from efficientnerf.geometry.cameras import Camera, Similarity, closest_similarity, rays

SQUARE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])  # seen from +z: clockwise from the top left, as OpenCV has them
MIN_VIEWS = 3
MAX_MISS = 0.0015  # of a picture's longest side: up to this root mean square a view agrees with where a marker is
MIN_AGREEING = 0.7  # share of the views of a marker that stood still
CORNER_BIAS = 0.1  # px of an edge's length that is no noise: what blur does to small markers, alike in all views
CONFIDENCE = 2.58  # standard deviations of the stated error: 99 %
ROUNDS = 30
FLAT = 0.01  # of the second extent of corners: a third up to this is a plane


@dataclass(frozen=True, eq=False)
class SquareFit:
    """A marker in the cameras' world."""

    square: Similarity  # takes SQUARE to its corners; its scale is the length of an edge
    spread: float  # standard deviation of the logarithm of that length
    agrees: np.ndarray  # (V,) the views that agree
    shift: float = 0.0  # standard deviation of its place that the cameras cause, by how far they miss it; they shift other markers, too

    @property
    def still(self) -> bool:
        """Whether it is in one place in nearly all views."""
        return bool(self.agrees.sum() >= MIN_VIEWS and self.agrees.mean() >= MIN_AGREEING)

    @property
    def corners(self) -> np.ndarray:
        """(4, 3)."""
        return self.square.points(SQUARE)


def fit_square(cameras: Sequence[Camera], corners: np.ndarray) -> SquareFit:
    """The square through corners (V, 4, 2), pixels of each camera's picture, centres at +0.5; views that see it elsewhere are left out."""
    views = len(cameras)
    seen = [rays(camera, places) for camera, places in zip(cameras, corners, strict=True)]
    origin, along = np.stack([each[0] for each in seen]), np.stack([each[1] for each in seen])  # (V, 4, 3)
    across = across_rays(along)  # (V, 4, 2, 3)
    focal = np.array([camera.intrinsics["fx"] for camera in cameras])
    limit = MAX_MISS * np.array([max(camera.width, camera.height) for camera in cameras])
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean(1)  # (V,) px
    weight = np.ones(views)
    agrees = np.ones(views, bool)
    square, inverse, miss = Similarity.identity(), np.full((7, 7), np.inf), np.zeros(views)
    for turn in range(ROUNDS):
        if turn < ROUNDS // 3:  # while the corners are free, few wrong views do no harm
            square = closest_similarity(SQUARE, meeting(origin, across, weight))
        off, slope = _offsets(square, origin, along, across, focal)  # (V, 4, 2), (V, 4, 2, 7)
        miss = np.sqrt((off**2).sum((1, 2)) / 4)
        weight = 1 / (1 + (miss / max(2 * float(np.median(miss)), 1e-9)) ** 2)
        if turn >= ROUNDS // 3:
            agrees = miss <= limit
            weight = weight if turn < 2 * ROUNDS // 3 else agrees.astype(float)
            inverse = np.linalg.pinv(np.einsum("v,vcki,vckj->ij", weight, slope, slope))
            square = _moved(square, -inverse @ np.einsum("v,vcki,vck->i", weight, slope, off))
    if not agrees.any():
        return SquareFit(square, np.inf, agrees)
    noise = float((miss[agrees] ** 2).sum() * 4 / max(8 * agrees.sum() - 7, 1))  # px^2 of a coordinate
    bias = CORNER_BIAS / float(np.median(edge[agrees]))
    distance = np.linalg.norm(origin[:, 0] - square.translation, axis=1)
    shift = np.sqrt(noise / agrees.sum()) * float(np.median((distance / focal)[agrees]))
    return SquareFit(square, float(np.sqrt(noise * inverse[6, 6] + bias**2)), agrees, float(shift))


def common_length(fits: Sequence[SquareFit]) -> tuple[float, float, float]:
    """The length of an edge by all of M fits, its relative error (99 %), and how many times as far apart the lengths are as their own errors explain."""
    return common_ratio(np.array([fit.square.scale for fit in fits]), np.array([fit.spread for fit in fits]))


def common_ratio(ratios: np.ndarray, spread: np.ndarray) -> tuple[float, float, float]:
    """The mean of (M,) measures of one ratio, with standard deviations (M,) of their logarithms; its error and how far apart they are as of `common_length`."""
    logs = np.log(ratios)
    weight = spread**-2 / (spread**-2).sum()
    mean = float(weight @ logs)
    excess = float(np.sqrt((((logs - mean) / spread) ** 2).sum() / max(len(logs) - 1, 1)))
    return float(np.exp(mean)), CONFIDENCE * float((spread**-2).sum() ** -0.5) * max(1.0, excess), excess


def common_normal(fits: Sequence[SquareFit]) -> tuple[np.ndarray, float] | None:
    """The unit normal of the plane of three markers or more, towards those who see them, and its error (99 %), degrees; None where they lie in none, or along a
    line."""
    if len(fits) < 3:
        return None
    points = np.concatenate([fit.corners for fit in fits])
    _, extent, axes = np.linalg.svd(points - points.mean(0), full_matrices=False)
    faces = np.array([fit.square.rotation[:, 2] for fit in fits])
    if extent[2] > FLAT * extent[1] or extent[1] < 0.1 * extent[0]:
        return None
    uneven = extent[2] / np.sqrt(len(fits) - 2)  # corners of one marker miss the plane alike
    shift = 2 * float(np.median([fit.shift for fit in fits]))  # `extent` counts each of the places four times
    error = np.degrees(np.arctan(CONFIDENCE * np.hypot(uneven, shift) / extent[1]))
    return axes[2] * np.sign((faces @ axes[2]).sum()), float(error)


def _offsets(square: Similarity, origin: np.ndarray, along: np.ndarray, across: np.ndarray, focal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(V, 4, 2) pixels from the rays to the corners, and (V, 4, 2, 7) their derivatives by turn, place and u."""
    arm = square.scale * SQUARE @ square.rotation.T  # (4, 3)
    off, by_point = offsets_from_rays(arm + square.translation, origin, along, across, focal)  # (V, 4, 2), (V, 4, 2, 3)
    turning = np.cross(arm[None, :, None], by_point)  # a . (w x arm) = w . (arm x a)
    growing = by_point @ arm[None, :, :, None]  # (V, 4, 2, 1)
    return off, np.concatenate([turning, by_point, growing], -1)


def _moved(square: Similarity, step: np.ndarray) -> Similarity:
    angle = float(np.linalg.norm(step[:3]))
    x, y, z = step[:3] / max(angle, 1e-300)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
    return Similarity(square.scale * float(np.exp(np.clip(step[6], -1, 1))), turn @ square.rotation, square.translation + step[3:6])
