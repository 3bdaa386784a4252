"""Vertices that are split where a texture has its seams: as many as files with one texture coordinate each have."""

from dataclasses import dataclass

import numpy as np

from efficientnerf.surface.mesh import Mesh


@dataclass(frozen=True, eq=False)
class Corners:
    """A mesh whose vertices have one texture coordinate each."""

    vertex: np.ndarray  # (N,) int64, the vertex of the mesh that each is a copy of; ascending
    coordinates: np.ndarray  # (N, 2) float32, v up
    faces: np.ndarray  # (F, 3) int64 of these


def split_at_seams(mesh: Mesh) -> Corners:
    """The mesh with a vertex for each pair of a vertex and a texture coordinate; its texture must not be None. Vertices without a face are left out."""
    assert mesh.texture is not None
    coordinates = np.ascontiguousarray(mesh.texture.coordinates.reshape(-1, 2), np.float32) + np.float32(0)  # no negative zeros
    place = coordinates.view(np.uint64).ravel()  # both numbers as one
    vertex = mesh.faces.ravel()
    order = np.lexsort((place, vertex))
    begins = np.ones(len(order), bool)
    begins[1:] = (np.diff(vertex[order]) != 0) | (place[order][1:] != place[order][:-1])
    faces = np.empty(len(order), np.int64)
    faces[order] = np.cumsum(begins) - 1
    first = order[begins]
    return Corners(vertex[first], coordinates[first], faces.reshape(-1, 3))
