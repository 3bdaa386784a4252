"""The input of surface extraction: a grid of densities with colours, in a frame of its own.

`Volume` is a tree in the world. `NdcVolume` is a forward-facing tree: its surface is found in normalised device coordinates and handed out in the
world. There a voxel is about a pixel wide at any depth, so that marching cubes, smoothing and decimation treat near and far as images do. Space
beyond the far limit is left out, for it reaches to infinity.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from efficientnerf.asset import queries
from efficientnerf.asset.tree import NerfTree, Region
from efficientnerf.backends.numba.tree import queries as frame_queries
from efficientnerf.geometry.directions import outside_directions
from efficientnerf.geometry.ndc import Ndc
from efficientnerf.surface.mesh import Mesh, vertex_normals

VOXELS_AT_ONCE = 2**20  # of bricks, while dense voxels are found
FARTHEST = 50.0  # times the near plane's depth: the far limit where the asset does not say


@dataclass(eq=False)
class Volume:
    """A tree, its points in its own frame."""

    tree: NerfTree
    region: Region | None = field(default=None, kw_only=True)  # that surfaces are clipped to, half way into the band in which opacity fades; None: not at all

    def density_block(self, low: Any, high: Any) -> np.ndarray:
        """Density at the voxel centres low <= (i, j, k) < high, zero outside of the grid."""
        return queries.density_block(self.tree, low, high)

    @cached_property
    def cells(self) -> np.ndarray:
        """(B, 3) coarse cells that own a brick, in order: density is nowhere else. A grid may be vast, and nearly empty."""
        return np.stack(np.unravel_index(np.flatnonzero(self.tree.brick_index.reshape(-1) >= 0), self.tree.shape), axis=1)

    def dense_voxels(self, threshold: float) -> Iterator[np.ndarray]:
        """(M, 3) voxels of at least this density, above zero, some bricks at a time."""
        tree, brick = self.tree, self.tree.brick
        each = max(1, VOXELS_AT_ONCE // brick**3)
        bricks = tree.brick_index[tuple(self.cells.T)]
        for begin in range(0, len(bricks), each):
            voxel = tree.voxel_index[bricks[begin : begin + each]]
            dense = voxel >= 0
            dense[dense] = tree.density_values[voxel[dense]] >= threshold
            owner, local = np.nonzero(dense)
            yield self.cells[begin + owner] * brick + np.stack(np.unravel_index(local, (brick,) * 3), axis=1)

    def filled_parts(self, axis: int, low: np.ndarray, high: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Corners of the parts of a column of bricks along `axis` that may have density; gaps do not count in its rays' depth."""
        others = [other for other in range(3) if other != axis]
        at = np.unique(self.cells[(self.cells[:, others] == low[others] // self.tree.brick).all(axis=1), axis])
        for run in np.split(at, np.flatnonzero(np.diff(at) > 1) + 1) if len(at) else ():
            begin, end = low.copy(), high.copy()
            begin[axis], end[axis] = run[0] * self.tree.brick, (run[-1] + 1) * self.tree.brick
            yield begin, end

    def filled_blocks(self, counts: list[int], block: int) -> np.ndarray:
        """(n, 3) numbers of the blocks that may hold a part of the surface, in order: those with a brick, and those next to them, where enclosed space may
        end."""
        at = np.unique(self.cells * self.tree.brick // block, axis=0)
        flat = np.zeros(0, np.int64)
        for offset in np.argwhere(np.ones((3, 3, 3), bool)) - 1:
            beside = at + offset
            beside = beside[((beside >= 0) & (beside < counts)).all(axis=1)]
            flat = np.union1d(flat, np.ravel_multi_index(tuple(beside.T), counts))
        return np.stack(np.unravel_index(flat, counts), axis=1)

    def density(self, points: np.ndarray) -> np.ndarray:
        """At points (N, 3) of the frame."""
        return frame_queries.density_at(self.tree, points)

    def colour(self, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """sRGB (N, 3) at points of the frame, along unit directions of the world."""
        return frame_queries.colour_at(self.tree, points, directions)

    def view_directions(self, points: np.ndarray, normals: np.ndarray) -> list[np.ndarray]:
        """Unit directions (N, 3) of the world that colours at points with these outward normals, of the frame, are looked up along: six from outside, so that
        neither a highlight nor a direction without training views decides."""
        return outside_directions(normals)

    def in_world(self, mesh: Mesh) -> Mesh:
        """A mesh of the frame in the world."""
        return mesh

    def inner(self, viewpoints: np.ndarray) -> np.ndarray:
        """Those of the viewpoints (N, 3) of the world that may lie in the volume, in its frame."""
        return viewpoints


@dataclass(eq=False)
class NdcVolume(Volume):
    """A tree in normalised device coordinates; see `Volume`."""

    ndc: Ndc

    @cached_property
    def layers(self) -> int:
        """How many layers of voxels along z' lie before the far limit."""
        far = float((self.tree.metadata.get("spiral") or {}).get("far", FARTHEST * self.ndc.near))
        return int(np.floor((1 - 2 * self.ndc.near / far - self.tree.bounds_min[2]) / self.tree.voxel))

    def density_block(self, low: Any, high: Any) -> np.ndarray:
        """Zero from the far limit on, too."""
        block = super().density_block(low, high)
        block[..., max(0, self.layers - int(low[2])) :] = 0
        return block

    def dense_voxels(self, threshold: float) -> Iterator[np.ndarray]:
        """None from the far limit on."""
        return (found[found[:, 2] < self.layers] for found in super().dense_voxels(threshold))

    def view_directions(self, points: np.ndarray, normals: np.ndarray) -> list[np.ndarray]:
        """From the reference camera and from about as far to the sides, above and below it as the cameras were: from elsewhere nothing is known of the colours,
        whatever the normals are."""
        x, y, _ = (self.tree.metadata.get("spiral") or {}).get("radii", (0.0, 0.0, 0.0))
        places = np.array([[0, 0, 0], [x, 0, 0], [-x, 0, 0], [0, y, 0], [0, -y, 0]], np.float64)
        centres = places @ self.ndc.world_from_camera[:3, :3].T + self.ndc.world_from_camera[:3, 3]
        away = [self.ndc.world(np.asarray(points, np.float64)) - centre for centre in centres]
        return [each / np.maximum(np.linalg.norm(each, axis=1, keepdims=True), 1e-12) for each in away]

    def in_world(self, mesh: Mesh) -> Mesh:
        """The map keeps the handedness, so that faces stay outside out."""
        vertices = self.ndc.world(mesh.vertices)
        return replace(mesh, vertices=vertices, normals=vertex_normals(vertices, mesh.faces))

    def inner(self, viewpoints: np.ndarray) -> np.ndarray:
        """None: the cameras are before the near plane."""
        return viewpoints[:0]


def volume_of(tree: NerfTree, region: Region | None = None) -> Volume:
    """The tree as a volume that is clipped to a region. It is interpolated: a surface lies between voxels, where those that hold its points may not be stored
    and have no colour."""
    tree = replace(tree, lookup="trilinear") if tree.lookup != "trilinear" else tree
    return Volume(tree, region=region) if tree.ndc is None else NdcVolume(tree, tree.ndc)
