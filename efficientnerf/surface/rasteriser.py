"""Images of meshes: which face each pixel shows, and how deep it lies. H x W pixels, V vertices, F faces."""

from dataclasses import dataclass

import numpy as np

from efficientnerf.backends.numba.mesh.rasterise import rasterise, row_spans
from efficientnerf.backends.pieces import pieces
from efficientnerf.geometry.cameras import Camera, project

BANDS = 16  # of rows, shared by threads
FIRST = 4096  # faces in the first piece


@dataclass(frozen=True, eq=False)
class MeshImage:
    """What a camera sees of a mesh."""

    face: np.ndarray  # (H, W) int32, -1 where there is none
    depth: np.ndarray  # (H, W) float32 along the view axis, infinite where there is no face

    @property
    def covered(self) -> np.ndarray:
        """(H, W) bool."""
        return self.face >= 0


def mesh_image(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> MeshImage:
    """The face that each pixel's centre meets first, from either side. Edges are straight between the distorted places of their ends; faces that reach behind
    the camera, or beyond what its lens shows, are left out."""
    pixels, depth = project(camera, vertices)
    near = np.zeros((camera.height, camera.width), np.float32)
    shown = np.full((camera.height, camera.width), -1, np.int32)
    faces = np.ascontiguousarray(faces, np.int64)
    rows = np.empty((len(faces), 2), np.int32)
    for part in pieces(len(faces), first=FIRST):
        row_spans(pixels, depth, faces, part.start, part.stop, camera.height, camera.width, rows)
        rasterise(pixels, depth, faces, rows, part.start, part.stop, min(BANDS, camera.height), near, shown)
    with np.errstate(divide="ignore"):
        return MeshImage(shown, np.where(shown >= 0, np.float32(1) / near, np.float32(np.inf)).astype(np.float32))
