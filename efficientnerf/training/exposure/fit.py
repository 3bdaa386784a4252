"""How photographs differ in exposure, from observations of the same points: log light of an observation = of the point + of the photograph +
vignetting of its camera, by robust least squares. Much better evidence than the brightness of photographs, which depends on what is in them.

O observations, P points, C photographs, K cameras.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

ROUNDS = 10  # of reweighting
LEAST_SCALE = 0.05  # logarithm: residuals below it are all alike, colours have 8 bits
STIFFNESS = 1.0  # observations that a photograph's gain of one, or a camera's vignetting, is kept back by: few of them are no witness


@dataclass(frozen=True, eq=False)
class ExposureFit:
    """What a fit to sparse points found."""

    gains: np.ndarray  # (C, 3) logarithms of gains, of mean zero
    vignetting: np.ndarray  # (K, 2) a and b of `efficientnerf.training.exposure.model`
    explained: float  # share of the weighted squares of the differences between observations of a point that these account for


def fit_exposure(light: np.ndarray, point: np.ndarray, view: np.ndarray, radius: np.ndarray, camera_of: np.ndarray) -> ExposureFit:
    """
    light      (O, 3) logarithms of linear light
    point      (O,) int64 of each observation, view (O,) int64 its photograph, radius (O,) r^2 in it
    camera_of  (C,) camera of each photograph
    """
    count, cameras = len(camera_of), int(camera_of.max()) + 1
    point = np.unique(point, return_inverse=True)[1]
    rows, of = np.arange(len(point)), camera_of[view]
    basis = np.stack([radius - 1 / 3, radius**2 - 1 / 9], axis=1)
    columns = [view, count + 2 * of, count + 2 * of + 1]
    values = [np.ones(len(rows)), *basis.T]
    size = count + 2 * cameras
    a = sparse.csr_matrix((np.concatenate(values), (np.tile(rows, 3), np.concatenate(columns))), (len(rows), size))
    points = sparse.csr_matrix((np.ones(len(rows)), (rows, point)), (len(rows), int(point.max(initial=-1)) + 1))
    brightness = light.mean(axis=1)
    weight = np.ones(len(rows))
    solved, unexplained = np.zeros((size, 4)), light
    for _ in range(ROUNDS):
        weighted = sparse.diags(weight) @ a
        total = np.maximum(points.T @ weight, 1e-12)
        cross = (points.T @ weighted).tocsr()
        normal = (a.T @ weighted - cross.T @ sparse.diags(1 / total) @ cross).toarray() + STIFFNESS * np.eye(size)
        known = np.concatenate([brightness[:, None], light], axis=1)  # (O, 4)
        right = weighted.T @ known - cross.T @ ((points.T @ (weight[:, None] * known)) / total[:, None])
        solved[:, 0] = np.linalg.solve(normal, right[:, 0])
        # Vignetting is that of brightness; each channel's gains are found with it.
        own = right[:, 1:] - normal[:, count:] @ np.repeat(solved[count:, :1], 3, axis=1)
        solved[:count, 1:] = np.linalg.solve(normal[:count, :count], own[:count])
        unexplained = _within(light - solved[view, 1:] - (basis * solved[count:, 0].reshape(-1, 2)[of]).sum(axis=1)[:, None], points, weight, total)
        size_of = np.sqrt((unexplained**2).mean(axis=1))
        scale = max(LEAST_SCALE, 1.4826 * float(np.median(size_of)))
        weight = 1 / (1 + (size_of / scale) ** 2)
    total = np.maximum(points.T @ weight, 1e-12)
    before = float((weight[:, None] * _within(light, points, weight, total) ** 2).sum())
    after = float((weight[:, None] * unexplained**2).sum())
    gains = solved[:count, 1:]
    explained = 0.0 if before <= 0 else max(0.0, 1 - after / before)
    return ExposureFit(gains - gains.mean(axis=0), solved[count:, 0].reshape(-1, 2), explained)


def _within(light: np.ndarray, points: np.ndarray, weight: np.ndarray, total: np.ndarray) -> np.ndarray:
    """Differences of observations from their point's weighted mean."""
    return np.asarray(light - points @ ((points.T @ (weight[:, None] * light)) / total[:, None]))
