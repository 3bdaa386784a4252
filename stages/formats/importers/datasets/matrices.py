"""Matrices of text files, and what a 3x4 projection holds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from efficientnerf.geometry.cameras import Camera
from pipeline.errors import BadInput
from stages.formats.importers import lenses
from stages.formats.importers.brown import brown_camera, without_skew

_AGAIN = "Write the data set again."


def pinhole(name: str, size: tuple[int, int], k: np.ndarray, where: str) -> Camera:
    """A camera at the origin from its (3, 3) matrix K, the centre of the first pixel being at 0.5, 0.5. Raises BadInput."""
    if abs(k[2] - (0, 0, 1)).max() > 1e-6 or k[1, 0]:
        raise BadInput(f"{where}: no matrix of a camera: rows {k[1].tolist()} and {k[2].tolist()}, expected 0 fy cy and 0 0 1. {_AGAIN}")
    camera = brown_camera(name, size, (k[0, 0], k[1, 1]), (k[0, 2], k[1, 2]), (), (0, 0), where)
    lenses.validated(camera, where)
    without_skew(k[0, 1], k[1, 1], size, k[1, 2], "a skew of", where)
    for centre, side in ((k[0, 2], size[0]), (k[1, 2], size[1])):
        if not 0.1 * side < centre < 0.9 * side:
            raise BadInput(
                f"{where}: the principal point {k[0, 2]:g}, {k[1, 2]:g} is not near the middle of an image of {size[0]}x{size[1]}; the camera belongs to"
                " images of another size. Use those that it was written for."
            )
    return camera


def pinhole_frame(k: np.ndarray, pose: np.ndarray, where: str, stated: tuple[int, int] | None = None) -> Callable[[str, tuple[int, int]], Camera]:
    """For a frame: the camera of K and a pose, at the stated (width, height) or else at the image's."""
    return lambda name, size: replace(pinhole(name, stated or size, k, where), world_from_camera=pose)


def from_world(matrix: np.ndarray, where: str) -> np.ndarray:
    """(4, 4) world to camera -> camera to world. Raises BadInput where it is no rigid motion."""
    rigid = lenses.rigid(matrix, where)
    pose = np.eye(4)
    pose[:3, :3] = rigid[:3, :3].T
    pose[:3, 3] = -rigid[:3, :3].T @ rigid[:3, 3]
    return pose


def decomposed(projection: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
    """(3, 4) K [R t] -> K (3, 3) with a positive diagonal and 1 at its end, and the pose (4, 4), camera to world. Raises BadInput."""
    left = projection[:, :3]
    if not abs(np.linalg.det(left)) > 1e-12 * max(np.abs(left).max(), 1e-30) ** 3:
        raise BadInput(f"{where}: no projection matrix (its left part is singular). {_AGAIN}")
    if np.linalg.det(left) < 0:
        projection, left = -projection, -left  # P and -P project alike
    q, r = np.linalg.qr(left[::-1].T)  # RQ by QR of the reversed rows
    k, turn = r.T[::-1, ::-1], q.T[::-1]
    signs = np.sign(np.diag(k))
    k, turn = k * signs, turn * signs[:, None]
    pose = np.eye(4)
    pose[:3, :3] = lenses.rotation(turn, where).T
    pose[:3, 3] = -np.linalg.solve(left, projection[:, 3])
    return k / k[2, 2], pose
