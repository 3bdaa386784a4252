"""Points where rays of photographs meet, and how sure their places and the lengths between them are.

Letters: V views, N points. Offsets from rays are in pixels of the middle of each picture, as in bundle adjustment.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from efficientnerf.geometry.cameras import Camera, rays

PICK_DEVIATION = 1.0  # px, the standard deviation of a pixel that someone points at; more where the rays pass each other farther apart
ROUNDS = 20


@dataclass(frozen=True, eq=False)
class Place:
    """A point of the cameras' world."""

    position: np.ndarray  # (3,)
    covariance: np.ndarray  # (3, 3) of it
    views: int = 0  # photographs that it was triangulated from; 0: it was given
    miss: float = 0.0  # root mean square distance from its rays, px

    @property
    def spread(self) -> float:
        """The standard deviation along its least sure axis."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.covariance)[-1], 0.0)))


def triangulated(cameras: Sequence[Camera], pixels: np.ndarray) -> Place:
    """The point of least squared offsets from the rays of pixels (V, 2), V >= 2. Raises ValueError where they have no point in common before the cameras."""
    seen = [rays(camera, pixel[None]) for camera, pixel in zip(cameras, np.asarray(pixels, np.float64), strict=True)]
    origin, along = np.stack([each[0] for each in seen]), np.stack([each[1] for each in seen])  # (V, 1, 3)
    across, focal = across_rays(along), np.array([camera.intrinsics["fx"] for camera in cameras])
    point = meeting(origin, across, np.ones(len(seen)))  # (1, 3)
    for _ in range(ROUNDS):
        if ((point - origin) * along).sum(-1).min() <= 0:
            raise ValueError("their rays do not meet before the cameras")
        off, slope = offsets_from_rays(point, origin, along, across, focal)  # (V, 1, 2), (V, 1, 2, 3)
        normal = np.einsum("vnki,vnkj->ij", slope, slope)
        if np.linalg.cond(normal) > 1e12:
            raise ValueError("they see it along one line")
        point = point - np.linalg.solve(normal, np.einsum("vnki,vnk->i", slope, off))
    squared = float((off**2).sum())
    noise = max(PICK_DEVIATION**2, squared / (2 * len(seen) - 3))
    return Place(point[0], noise * np.linalg.inv(normal), len(seen), float(np.sqrt(squared / len(seen))))


def length_between(a: Place, b: Place) -> tuple[float, float]:
    """The distance of two places, and its standard deviation."""
    way = b.position - a.position
    length = float(np.linalg.norm(way))
    both = a.covariance + b.covariance
    if length == 0:
        return 0.0, float(np.sqrt(np.linalg.eigvalsh(both)[-1]))
    return length, float(np.sqrt(max(way @ both @ way, 0.0))) / length


def across_rays(along: np.ndarray) -> np.ndarray:
    """(..., 2, 3) two unit vectors at right angles to unit directions (..., 3) and to each other."""
    side = np.cross(along, np.where(np.abs(along[..., :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    return np.stack([side, np.cross(along, side)], -2)


def meeting(origin: np.ndarray, across: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(N, 3) the points nearest to N rays of each view: origins (V, N, 3), `across_rays` (V, N, 2, 3), weights of the views (V,)."""
    matrix = np.einsum("v,vcki,vckj->cij", weight, across, across)
    return np.asarray(np.linalg.solve(matrix + 1e-12 * np.eye(3), np.einsum("v,vcki,vckj,vcj->ci", weight, across, across, origin)[..., None])[..., 0])


def offsets_from_rays(
    points: np.ndarray, origin: np.ndarray, along: np.ndarray, across: np.ndarray, focal: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(V, N, 2) pixels from rays to the points (N, 3), and (V, N, 2, 3) their derivatives by the points.

    origin, along  (V, N, 3); across (V, N, 2, 3); focal (V,) px
    """
    to = points - origin  # (V, N, 3)
    depth = (to * along).sum(-1)[..., None]  # (V, N, 1)
    tangent = (across @ to[..., None])[..., 0] / depth
    by_point = focal[:, None, None, None] * (across - tangent[..., None] * along[:, :, None]) / depth[..., None]
    return focal[:, None, None] * tangent, by_point
