"""3D Gaussians, as 3DGS (Kerbl et al. 2023) renders them: a surface or a scene as ellipsoids that other programs show.

A Gaussian hides at most its opacity, at its mean, and the less the farther away: alpha = opacity exp(-q / 2), q the squared distance in standard deviations.
Its colour along a unit view direction d is max(0, 1/2 + sum_k harmonics_k Y_k(d)), sRGB; the basis is that of `efficientnerf.rendering.harmonics`.

N Gaussians, K harmonics.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

MAX_DEGREE = 3  # the most in formats and programs of 3DGS


@dataclass(frozen=True, eq=False)
class Gaussians:
    """3D Gaussians. Raises ValueError for arrays of other shapes or types, and for values outside of these ranges."""

    means: np.ndarray  # (N, 3) float32  in the asset's scene frame
    scales: np.ndarray  # (N, 3) float32  standard deviations along the own axes, above 0
    rotations: np.ndarray  # (N, 4) float32  unit quaternions w x y z: own axes to the scene's
    opacities: np.ndarray  # (N,)   float32  between 0 and 1, both excluded
    harmonics: np.ndarray  # (N, K, 3) float32

    def __post_init__(self) -> None:
        count = len(self.means)
        terms = self.harmonics.shape[1] if self.harmonics.ndim == 3 else 0
        if terms not in [(degree + 1) ** 2 for degree in range(MAX_DEGREE + 1)]:
            raise ValueError(f"Gaussians: harmonics of shape {self.harmonics.shape}; expected ({count}, K, 3) with K = 1, 4, 9 or 16")
        shapes = {"means": (count, 3), "scales": (count, 3), "rotations": (count, 4), "opacities": (count,), "harmonics": (count, terms, 3)}
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array.shape != shape or array.dtype != np.float32:
                raise ValueError(f"Gaussians: {name} of shape {array.shape} and type {array.dtype}; expected {shape} float32")
            if not np.isfinite(array).all():
                raise ValueError(f"Gaussians: {name} that are not finite")
        if not (self.scales > 0).all():
            raise ValueError("Gaussians: scales that are not above 0")
        if not ((self.opacities > 0) & (self.opacities < 1)).all():
            raise ValueError("Gaussians: opacities that are not between 0 and 1")
        if not (np.abs(np.square(self.rotations.astype(np.float64)).sum(axis=1) - 1) < 1e-3).all():
            raise ValueError("Gaussians: rotations that are not unit quaternions")

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Of the harmonics."""
        return round(self.harmonics.shape[1] ** 0.5) - 1

    def subset(self, chosen: np.ndarray) -> Gaussians:
        """Those that an index or a mask chooses."""
        return Gaussians(self.means[chosen], self.scales[chosen], self.rotations[chosen], self.opacities[chosen], self.harmonics[chosen])


def rotation_matrices(quaternions: np.ndarray) -> np.ndarray:
    """(N, 3, 3) float64 of quaternions (N, 4) w x y z of any length above 0."""
    w, x, y, z = (np.asarray(quaternions, np.float64) / np.linalg.norm(np.asarray(quaternions, np.float64), axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternions_from(matrices: np.ndarray) -> np.ndarray:
    """(N, 4) float64 unit quaternions w x y z, w >= 0, of rotations (N, 3, 3)."""
    m = np.asarray(matrices, np.float64)
    xx, yy, zz = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    # Four times the products of a quaternion's parts: each row is the quaternion times one of them, and the row of the greatest part is exact.
    products = np.stack(
        [
            np.stack([1 + xx + yy + zz, m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], axis=-1),
            np.stack([m[:, 2, 1] - m[:, 1, 2], 1 + xx - yy - zz, m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0]], axis=-1),
            np.stack([m[:, 0, 2] - m[:, 2, 0], m[:, 0, 1] + m[:, 1, 0], 1 - xx + yy - zz, m[:, 1, 2] + m[:, 2, 1]], axis=-1),
            np.stack([m[:, 1, 0] - m[:, 0, 1], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1], 1 - xx - yy + zz], axis=-1),
        ],
        axis=1,
    )
    greatest = np.argmax(np.stack([products[:, n, n] for n in range(4)], axis=-1), axis=1)
    chosen = products[np.arange(len(m)), greatest]
    chosen = chosen / np.linalg.norm(chosen, axis=1, keepdims=True)
    return np.where(chosen[:, :1] < 0, -chosen, chosen)
