"""Stand-ins with closed forms: a ball that answers like a NerfTree, and a renderer of it with surroundings that answers like a FieldRenderer."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from efficientnerf.asset.rendering import Rendering
from efficientnerf.geometry.cameras import Camera, Similarity, rays
from efficientnerf.rendering.field_renderer import FieldRendering, SampleCounts
from stages.evaluate.asset import EvaluatedAsset

WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class BallTree:
    """A ball of uniform density inside a box, with the interface of a NerfTree.

    Its colour is sRGB 0.2 + 0.6 (x - bounds_min) / size, from where a ray enters it.
    """

    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: float = 0.6
    sigma: float = 40.0
    shape: tuple[int, int, int] = (16, 16, 16)
    brick: int = 4
    voxel: float = 2.0 / 64
    background: tuple[float, float, float] | None = WHITE
    similarity: Similarity = field(default_factory=Similarity.identity)
    forward_facing: bool = False
    ndc: None = None
    outer: tuple[()] = ()
    region: None = None
    environment: None = None

    @property
    def bounds_min(self) -> np.ndarray:
        return -0.5 * np.asarray(self.shape) * self.brick * self.voxel

    @property
    def bounds_max(self) -> np.ndarray:
        return -self.bounds_min

    @property
    def brick_index(self) -> np.ndarray:
        """Numbers the coarse cells that the ball may touch; -1 elsewhere."""
        side = self.brick * self.voxel
        axes = [self.bounds_min[k] + (np.arange(self.shape[k]) + 0.5) * side for k in range(3)]
        away = np.linalg.norm(np.stack(np.meshgrid(*axes, indexing="ij"), -1) - self.centre, axis=-1)
        occupied = away < self.radius + 0.5 * np.sqrt(3.0) * side
        return np.where(occupied, np.cumsum(occupied).reshape(self.shape) - 1, -1).astype(np.int32)

    @property
    def metadata(self) -> dict[str, Any]:
        s = self.similarity
        return {
            "world_from_capture": {"scale": s.scale, "rotation": s.rotation.tolist(), "translation": list(s.translation)},
            "orbit": {"centre": [0.0, 0.0, 0.0], "radius": 4.0, "elevation": 30.0, "forward_facing": self.forward_facing, "heading": 90.0},
            "metric": False,
            "provenance": {"source": "a ball"},
        }

    def density(self, points: np.ndarray) -> np.ndarray:
        points = np.asarray(points, np.float64)
        inside = np.linalg.norm(points - self.centre, axis=-1) < self.radius
        return np.where(inside, self.sigma, 0.0).astype(np.float32)

    def colour(self, points: np.ndarray, directions: np.ndarray | None = None) -> np.ndarray:
        size = self.bounds_max - self.bounds_min
        return np.clip(0.2 + 0.6 * (np.asarray(points) - self.bounds_min) / size, 0.0, 1.0).astype(np.float32)

    def normal(self, points: np.ndarray) -> np.ndarray:
        away = np.asarray(points, np.float64) - self.centre
        return (away / np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-12)).astype(np.float32)

    def density_block(self, lo: tuple[int, int, int], hi: tuple[int, int, int]) -> np.ndarray:
        axes = [self.bounds_min[k] + (np.arange(lo[k], hi[k]) + 0.5) * self.voxel for k in range(3)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
        size = np.asarray(self.shape) * self.brick
        inside = np.ones(points.shape[:3], bool)
        for k in range(3):
            index = np.arange(lo[k], hi[k])
            ok = (index >= 0) & (index < size[k])
            inside &= ok.reshape([-1 if axis == k else 1 for axis in range(3)])
        return np.where(inside, self.density(points), 0.0).astype(np.float32)

    def render_rays(self, origins: np.ndarray, directions: np.ndarray) -> Rendering:
        """Closed form: opacity 1 - exp(-sigma chord), depth where the transmittance has fallen to one half."""
        to_centre = np.asarray(self.centre) - origins
        middle = (to_centre * directions).sum(-1)
        half = np.sqrt(np.maximum(self.radius**2 - ((to_centre**2).sum(-1) - middle**2), 0.0))
        near, far = np.maximum(middle - half, 0.0), np.maximum(middle + half, 0.0)
        opacity = 1.0 - np.exp(-self.sigma * (far - near))
        hit = origins + near[:, None] * directions
        colour = self.colour(hit) * opacity[:, None]
        depth = np.where(opacity >= 0.5, near + np.log(2.0) / self.sigma, np.inf)
        normal = np.where(opacity[:, None] > 0, self.normal(hit), 0.0)
        return Rendering(colour.astype(np.float32), opacity.astype(np.float32), depth.astype(np.float32), normal.astype(np.float32))

    def opacity_nearer(self, origins: np.ndarray, directions: np.ndarray, limits: np.ndarray) -> np.ndarray:
        """Closed form, as above."""
        to_centre = np.asarray(self.centre) - origins
        middle = (to_centre * directions).sum(-1)
        half = np.sqrt(np.maximum(self.radius**2 - ((to_centre**2).sum(-1) - middle**2), 0.0))
        near, far = np.maximum(middle - half, 0.0), np.maximum(middle + half, 0.0)
        return 1.0 - np.exp(-self.sigma * np.maximum(np.minimum(far, limits) - near, 0.0))

    def evaluated(self) -> EvaluatedAsset:
        """As the evaluate stage sees it; margins of 2 % of the distance."""
        return EvaluatedAsset(self.render, limits=lambda origins, directions, distance: 0.98 * distance, nearer=self.opacity_nearer)

    def render(
        self, camera: Camera, *, background: tuple[float, float, float] | None = None, supersample: int = 1, normals: bool = True
    ) -> Rendering:
        origins, directions = rays(camera)
        flat = self.render_rays(origins, directions)
        size = (camera.height, camera.width)
        colour = flat.colour
        if background is not None:
            colour = colour + (1.0 - flat.opacity[:, None]) * np.asarray(background, np.float32)
        depth = flat.depth * (directions @ camera.forward).astype(np.float32)
        normal = flat.normal.reshape(*size, 3) if normals else np.zeros((0, 0, 3), np.float32)
        return Rendering(colour.reshape(*size, 3), flat.opacity.reshape(size), depth.reshape(size), normal)


@dataclass
class BallField:
    """The same ball before a background that is a smooth function of the direction (or one colour), as a FieldRenderer sees it.

    noise  added to its colour, as a chequered pattern
    """

    tree: BallTree
    background: tuple[float, float, float] | None = None
    noise: float = 0.0
    calls: list[tuple[str, int, int]] = field(default_factory=list)

    def colour(self, camera: Camera, progress: Any = None) -> np.ndarray:
        return self.render(camera, progress).colour

    def render(
        self,
        camera: Camera,
        progress: Any = None,
        *,
        box: np.ndarray | None = None,
        reach: np.ndarray | None = None,
        limits: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None = None,
    ) -> FieldRendering:
        """The ball lies in any box that is asked for."""
        self.calls.append((camera.name, camera.width, camera.height))
        inner = self.tree.render(camera)
        size = (camera.height, camera.width)
        origins, directions = rays(camera)
        if self.background is None:
            behind = (0.5 + 0.3 * np.sin(2.0 * directions)).reshape(*size, 3).astype(np.float32)
        else:
            behind = np.broadcast_to(np.asarray(self.background, np.float32), (*size, 3)).copy()
        colour = inner.colour + (1.0 - inner.opacity[..., None]) * behind
        if self.noise:
            pattern = np.indices(size).sum(0) % 2 * 2.0 - 1.0
            colour = colour + (self.noise * pattern[..., None]).astype(np.float32)
        if progress is not None:
            progress(camera.width * camera.height, camera.width * camera.height)
        nearer = None
        if limits is not None:
            distance = self.tree.render_rays(origins, directions).depth
            nearer = self.tree.opacity_nearer(origins, directions, limits(origins, directions, distance)).reshape(size)
        before = np.zeros((*size, 4), np.float32)
        return FieldRendering(colour, inner.opacity, inner.depth, before, behind, inner.opacity, SampleCounts(), inner.opacity, nearer)
