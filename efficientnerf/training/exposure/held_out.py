"""The exposure of photographs that training did not see: a camera that sets exposure by itself sets it alike for views that are alike.

It is that of the nearest training photographs, times how well theirs predicts a training photograph's own: 1 where exposure changes slowly from view to
view, 0 where each photograph has an exposure at random and the mean is the better guess. No held-back photograph is looked at.
"""

from collections.abc import Sequence

import numpy as np

from efficientnerf.geometry.cameras import Camera

NEAREST = 2  # training photographs that a gain is the mean of. docs/experiments/exposure.md


def predicted_gains(gains: np.ndarray, cameras: Sequence[Camera], others: Sequence[Camera]) -> np.ndarray:
    """(H, 3) logarithms of the gains of photographs taken with the cameras `others`.

    gains    (C, 3) logarithms of those of training photographs, of mean zero
    cameras  of these
    """
    if len(cameras) <= NEAREST or not others:
        return np.zeros((len(others), 3))
    apart = _distances(cameras, cameras)
    np.fill_diagonal(apart, np.inf)
    predicted = _mean_of_nearest(gains, apart)
    trust = (gains * predicted).sum() / max(float((predicted**2).sum()), 1e-12)
    return np.asarray(np.clip(trust, 0, 1) * _mean_of_nearest(gains, _distances(others, cameras)))


def _mean_of_nearest(gains: np.ndarray, apart: np.ndarray) -> np.ndarray:
    """(H, 3) means of the gains (C, 3) of the nearest by `apart` (H, C)."""
    return np.asarray(gains[np.argsort(apart, axis=1, kind="stable")[:, :NEAREST]].mean(axis=1))


def _distances(some: Sequence[Camera], cameras: Sequence[Camera]) -> np.ndarray:
    """(H, C) how different views are: distance of the centres over the deviation of the cameras from their mean, and of the unit view axes."""
    centres, axes = (np.array([getattr(camera, name) for camera in cameras]) for name in ("centre", "forward"))
    spread = np.linalg.norm(centres - centres.mean(axis=0), axis=1).mean()
    between = np.linalg.norm(np.array([camera.centre for camera in some])[:, None] - centres, axis=-1) / max(float(spread), 1e-12)
    return np.asarray(between + np.linalg.norm(np.array([camera.forward for camera in some])[:, None] - axes, axis=-1))
