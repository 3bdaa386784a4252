"""The surface of a forward-facing tree: found in its normalised device coordinates, handed out in the world.

There a voxel is about a pixel wide wherever it lies, so that marching, smoothing and thinning treat near and far as the pictures do. What lies
beyond the far limit is a backdrop and left out: its image reaches to infinity.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from efficientnerf.geometry.ndc import Ndc
from efficientnerf.surface.mesh import Mesh, PointCloud, vertex_normals

FARTHEST = 50.0  # times the near plane's depth: the far limit where the asset does not say


@dataclass(frozen=True, eq=False)
class FrameTree:
    """A tree in normalised device coordinates, as `efficientnerf.surface.isosurface` wants one: points are of that frame, directions of the world."""

    tree: Any

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.tree.shape

    @property
    def brick(self) -> int:
        return int(self.tree.brick)

    @property
    def voxel(self) -> float:
        return float(self.tree.voxel)

    @property
    def bounds_min(self) -> np.ndarray:
        return np.asarray(self.tree.bounds_min)

    @property
    def ndc(self) -> Ndc:
        return self.tree.ndc

    @cached_property
    def layers(self) -> int:
        """How many layers of voxels along z' lie before the far limit."""
        far = float((self.tree.metadata.get("spiral") or {}).get("far", FARTHEST * self.ndc.near))
        return int(np.floor((1 - 2 * self.ndc.near / far - self.bounds_min[2]) / self.voxel))

    def density_block(self, low: Any, high: Any) -> np.ndarray:
        """As `NerfTree.density_block`, nothing from the far limit on."""
        block = self.tree.density_block(low, high)
        block[..., max(0, self.layers - int(low[2])) :] = 0
        return block

    def density(self, points: np.ndarray) -> np.ndarray:
        from efficientnerf.backends.numba.tree.rendering import density_at

        return density_at(self.tree, points)

    def colour(self, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
        from efficientnerf.backends.numba.tree.rendering import colour_at

        return colour_at(self.tree, points, directions)

    def looking(self, points: np.ndarray, normals: np.ndarray) -> list[np.ndarray]:
        """Unit directions (N, 3) of the world along which the cameras saw points of the frame: from the reference camera, and from about as far
        beside, above and below it as they stood. From elsewhere nothing is known of the colours, whatever the normals are."""
        x, y, _ = (self.tree.metadata.get("spiral") or {}).get("radii", (0.0, 0.0, 0.0))
        places = np.array([[0, 0, 0], [x, 0, 0], [-x, 0, 0], [0, y, 0], [0, -y, 0]], np.float64)
        centres = places @ self.ndc.world_from_camera[:3, :3].T + self.ndc.world_from_camera[:3, 3]
        away = [self.ndc.world(np.asarray(points, np.float64)) - centre for centre in centres]
        return [each / np.maximum(np.linalg.norm(each, axis=1, keepdims=True), 1e-12) for each in away]

    def mesh(self, mesh: Mesh) -> Mesh:
        """A mesh of the frame in the world. The map keeps the handedness, so that faces stay outside out."""
        vertices = self.ndc.world(mesh.vertices)
        return replace(mesh, vertices=vertices, normals=vertex_normals(vertices, mesh.faces))

    def points(self, cloud: PointCloud) -> PointCloud:
        """A cloud of the frame in the world."""
        return replace(cloud, positions=self.ndc.world(cloud.positions), normals=self.ndc.world_normals(cloud.positions, cloud.normals))
