"""Poses of cameras."""

import numpy as np
from numpy.typing import ArrayLike


def looking_at(centre: ArrayLike, target: ArrayLike = (0, 0, 0), up: ArrayLike = (0, 0, 1)) -> np.ndarray:
    """(4, 4) world from camera (x right, y down, z forward) of a level camera."""
    forward = np.asarray(target, np.float64) - np.asarray(centre)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, np.asarray(centre)], -1)
    return pose
