"""The captured cameras as an asset keeps them (metadata `captured_path`), where their axes meet, and the part of the sphere round a subject that they cover."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from efficientnerf.geometry.cameras import Camera
from pipeline.errors import BadInput

MAX_POSES = 64  # that an asset keeps, evenly spaced over the capture
DIGITS = 6
LARGEST = 1e30
WIDEST_GAP, GAP_STEPS = 75.0, 2.5  # degrees between neighbouring cameras, or so many times their mean angle: with a wider gap they do not go round


@dataclass(frozen=True, eq=False)
class CapturedPath:
    """Some of the cameras of a capture, in the order of their files.

    poses          (C, 4, 4) training frame
    width, height  of the median photograph, pixels
    focal          pixels
    """

    poses: np.ndarray
    width: float
    height: float
    focal: float

    @property
    def centres(self) -> np.ndarray:
        """(C, 3)."""
        return np.asarray(self.poses[:, :3, 3])


@dataclass(frozen=True)
class Coverage:
    """How a capture's cameras stand round a point; angles in degrees.

    distance   median, world units
    elevation  median angle above the horizon
    heights    half of the range of elevations, without the tenth at each end
    heading    azimuth of the middle of the cameras, anticlockwise from +x
    arc        range of azimuths that they cover, without the twentieth at each end; 360 where they go round
    """

    distance: float
    elevation: float
    heights: float
    heading: float
    arc: float


def captured_metadata(cameras: Sequence[Camera]) -> dict[str, Any]:
    """The metadata `captured_path` of cameras in the training frame, at least one."""
    chosen = [cameras[n] for n in np.unique(np.linspace(0, len(cameras) - 1, min(MAX_POSES, len(cameras))).round().astype(int))]
    sizes = np.array([(camera.width, camera.height, camera.intrinsics["fx"]) for camera in cameras], np.float64)
    usual = (sizes[:, 0] >= sizes[:, 1]) == ((sizes[:, 0] >= sizes[:, 1]).mean() >= 0.5)
    width, height, focal = np.median(sizes[usual], axis=0)
    poses = [[float(f"{x:.{DIGITS}g}") for x in camera.world_from_camera[:3].ravel()] for camera in chosen]
    return {"width": float(width), "height": float(height), "focal": float(f"{focal:.{DIGITS}g}"), "poses": poses}


def captured_of(metadata: Mapping[str, Any]) -> CapturedPath | None:
    """The captured cameras in an asset's metadata; None where it keeps none. Raises BadInput."""
    given = metadata.get("captured_path")
    if given is None:
        return None
    try:
        rows = np.array(given["poses"], np.float64)
        width, height, focal = (float(given[name]) for name in ("width", "height", "focal"))
        if rows.ndim != 2 or rows.shape[1] != 12 or not 1 <= len(rows) <= MAX_POSES or not (np.abs(rows) < LARGEST).all():
            raise ValueError(f"poses of shape {rows.shape}; expected 1 to {MAX_POSES} of twelve numbers")
        if not (min(width, height) >= 1 and max(width, height) <= 1e6 and 1e-3 * width <= focal <= 1e4 * width):
            raise ValueError(f"a camera of {width:g} x {height:g} pixels and focal length {focal:g}")
        poses = np.tile(np.eye(4), (len(rows), 1, 1))
        poses[:, :3] = rows.reshape(-1, 3, 4)
        poses[:, :3, :3] = [_rotation(matrix) for matrix in poses[:, :3, :3]]
    except (KeyError, OverflowError, TypeError, ValueError, np.linalg.LinAlgError) as error:
        raise BadInput(f"asset: its captured_path cannot be read ({str(error)[:200]}). Bake it again.") from error
    return CapturedPath(poses, width, height, focal)


def _rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotation nearest to a matrix of rounded numbers; ValueError where it is none."""
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-3 or np.linalg.det(matrix) < 0:
        raise ValueError("a pose that is no rigid motion")
    u, _, v = np.linalg.svd(matrix)
    return np.asarray(u @ v)


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
    """The point (3,) nearest to all view axes, and whether they meet there, before the cameras and from different sides."""
    centres, forward = np.array([camera.centre for camera in cameras]), np.array([camera.forward for camera in cameras])
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]  # (C, 3, 3)
    point = centres.mean(axis=0)
    if np.linalg.eigvalsh(across.mean(axis=0))[0] < 0.03:  # about 10 degrees apart
        return point, False
    weight = np.ones(len(cameras))
    for _ in range(20):
        point = np.linalg.solve((weight[:, None, None] * across).sum(0), (weight[:, None, None] * across @ centres[:, :, None]).sum(0)[:, 0])
        miss = np.linalg.norm((across @ (point - centres)[:, :, None])[..., 0], axis=1)
        weight = 1 / (1 + (miss / max(float(np.median(miss)), 1e-12)) ** 2)
    ahead = ((point - centres) * forward).sum(axis=1)
    return point, bool((ahead > 0).mean() >= 0.8 and np.median(miss) < 0.5 * np.median(np.linalg.norm(point - centres, axis=1)))
