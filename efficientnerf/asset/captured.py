"""The captured cameras as an asset keeps them (metadata `captured_path`)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from efficientnerf.geometry.cameras import Camera

MAX_POSES = 64  # that an asset keeps, evenly spaced over the capture
DIGITS = 6
LARGEST = 1e30


class MetadataError(ValueError):
    """Metadata of an asset that make no sense, or lack what was asked for."""

    bad_input = True  # to the engine and the command line


@dataclass(frozen=True, eq=False)
class CapturedPath:
    """Some of the cameras of a capture, in the order of their files."""

    poses: np.ndarray  # (C, 4, 4) training frame
    # width, height: of the median photograph, pixels
    width: float
    height: float
    focal: float  # pixels

    @property
    def centres(self) -> np.ndarray:
        """(C, 3)."""
        return np.asarray(self.poses[:, :3, 3])

    def cameras(self, scale: float) -> list[Camera]:
        """Them, with images of this scale."""
        width, height = (max(1, round(side * scale)) for side in (self.width, self.height))
        lens = (self.focal * scale, width / 2, height / 2)
        return [Camera(f"captured_{n:04d}", width, height, "SIMPLE_PINHOLE", lens, pose) for n, pose in enumerate(self.poses)]


def captured_metadata(cameras: Sequence[Camera]) -> dict[str, Any]:
    """The metadata `captured_path` of cameras in the training frame, at least one."""
    chosen = [cameras[n] for n in np.unique(np.linspace(0, len(cameras) - 1, min(MAX_POSES, len(cameras))).round().astype(int))]
    sizes = np.array([(camera.width, camera.height, camera.intrinsics["fx"]) for camera in cameras], np.float64)
    usual = (sizes[:, 0] >= sizes[:, 1]) == ((sizes[:, 0] >= sizes[:, 1]).mean() >= 0.5)
    width, height, focal = np.median(sizes[usual], axis=0)
    poses = [[float(f"{x:.{DIGITS}g}") for x in camera.world_from_camera[:3].ravel()] for camera in chosen]
    return {"width": float(width), "height": float(height), "focal": float(f"{focal:.{DIGITS}g}"), "poses": poses}


def captured_of(metadata: Mapping[str, Any]) -> CapturedPath | None:
    """The captured cameras in an asset's metadata; None where it keeps none. Raises MetadataError."""
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
        raise MetadataError(f"asset: its captured_path cannot be read ({str(error)[:200]}). Bake it again.") from error
    return CapturedPath(poses, width, height, focal)


def _rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotation nearest to a matrix of rounded numbers; ValueError where it is none."""
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-3 or np.linalg.det(matrix) < 0:
        raise ValueError("a pose that is no rigid motion")
    u, _, v = np.linalg.svd(matrix)
    return np.asarray(u @ v)
