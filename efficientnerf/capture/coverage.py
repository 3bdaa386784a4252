"""How a capture's cameras stand: where their axes meet, and the part of the sphere round a subject that they cover."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from efficientnerf.geometry.cameras import Camera

MIN_CONVERGENCE = 0.03  # mean squared sine of the angles between view axes and their mean (10 degrees), below which they do not meet in a point
WIDEST_GAP, GAP_STEPS = 75.0, 2.5  # degrees between neighbouring cameras, or so many times their mean angle: with a wider gap they do not go round


@dataclass(frozen=True)
class Coverage:
    """How a capture's cameras stand round a point; angles in degrees."""

    distance: float  # median, world units
    elevation: float  # median angle above the horizon
    heights: float  # half of the range of elevations, without the tenth at each end
    heading: float  # azimuth of the middle of the cameras, anticlockwise from +x
    arc: float  # range of azimuths that they cover, without the twentieth at each end; 360 where they go round


def coverage(centres: np.ndarray, target: np.ndarray) -> Coverage:
    """How cameras at (C, 3) cover the sphere round a point (3,), z up."""
    offsets = np.asarray(centres, np.float64) - target
    distance = np.linalg.norm(offsets, axis=1)
    elevation = np.degrees(np.arcsin(np.clip(offsets[:, 2] / np.maximum(distance, 1e-12), -1, 1)))
    azimuth = np.sort(np.degrees(np.arctan2(offsets[:, 1], offsets[:, 0])))
    gaps = np.diff(np.append(azimuth, azimuth[0] + 360.0))
    widest = int(np.argmax(gaps))
    middle = azimuth[widest] + gaps[widest] / 2 + 180.0
    closed = gaps[widest] <= max(WIDEST_GAP, min(GAP_STEPS * 360.0 / len(centres), 150.0))
    aside = (azimuth - middle + 180.0) % 360.0 - 180.0
    first, last = np.quantile(aside, [0.05, 0.95])
    heading = middle if closed else middle + (first + last) / 2
    low, high = np.quantile(elevation, [0.1, 0.9])
    return Coverage(
        distance=float(np.median(distance)),
        elevation=float(np.median(elevation)),
        heights=float(high - low) / 2,
        heading=float((heading + 180.0) % 360.0 - 180.0),
        arc=360.0 if closed else float(last - first),
    )


def meeting_point(cameras: Sequence[Camera]) -> tuple[np.ndarray, bool]:
    """The point (3,) nearest to all view axes, by robust least squares, and whether they meet there, before the cameras and from different sides."""
    centres, forward = np.array([camera.centre for camera in cameras]), np.array([camera.forward for camera in cameras])
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]  # (C, 3, 3)
    point = centres.mean(axis=0)
    if np.linalg.eigvalsh(across.mean(axis=0))[0] <= MIN_CONVERGENCE:
        return point, False
    weight = np.ones(len(cameras))
    for _ in range(20):
        point = np.linalg.solve((weight[:, None, None] * across).sum(0), (weight[:, None, None] * across @ centres[:, :, None]).sum(0)[:, 0])
        miss = np.linalg.norm((across @ (point - centres)[:, :, None])[..., 0], axis=1)
        weight = 1 / (1 + (miss / max(float(np.median(miss)), 1e-12)) ** 2)
    ahead = ((point - centres) * forward).sum(axis=1)
    return point, bool((ahead > 0).mean() >= 0.8 and np.median(miss) < 0.5 * np.median(np.linalg.norm(point - centres, axis=1)))
