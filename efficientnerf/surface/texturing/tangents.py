"""Tangents of a mesh with texture coordinates, as in MikkTSpace: the frame in which a normal map says how light meets the surface.

A face's tangent points where u grows. That of a vertex is the mean over the faces that share it and its texture coordinate, each turned into the plane of the
vertex's normal, weighted by the angle of the face there. The bitangent is sign * (normal x tangent) and points where v grows (up). Between vertices normal and
tangent are interpolated as they are, not brought to length one. Mikkelsen, "Simulation of wrinkled surfaces revisited", 2008.
"""

import numpy as np


def tangents(vertices: np.ndarray, normals: np.ndarray, coordinates: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(N, 4) float64 unit tangents and the sign, 1 or -1, of the bitangent.

    vertices, normals  (N, 3), split where a vertex has several coordinates
    coordinates        (N, 2), v up
    faces              (F, 3)
    """
    corners, places = vertices[faces], coordinates[faces]
    edges, steps = corners[:, 1:] - corners[:, :1], places[:, 1:] - places[:, :1]
    area = steps[:, 0, 0] * steps[:, 1, 1] - steps[:, 1, 0] * steps[:, 0, 1]
    sign = np.where(area < 0, -1.0, 1.0)
    along = sign[:, None] * (steps[:, 1, 1, None] * edges[:, 0] - steps[:, 0, 1, None] * edges[:, 1])
    sums, signs = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
    for corner in range(3):
        at = faces[:, corner]
        normal = normals[at]
        sides = [_in_plane(corners[:, (corner + turn) % 3] - corners[:, corner], normal) for turn in (1, 2)]
        angle = np.where(area != 0, np.arccos(np.clip((sides[0] * sides[1]).sum(1), -1, 1)), 0)
        part = angle[:, None] * _in_plane(along, normal)
        for axis in range(3):
            sums[:, axis] += np.bincount(at, part[:, axis], minlength=len(vertices))
        signs += np.bincount(at, angle * sign, minlength=len(vertices))
    found = _in_plane(sums, normals)
    found = np.where((found != 0).any(1, keepdims=True), found, _in_plane(_beside(normals), normals))
    return np.concatenate([found, np.where(signs < 0, -1.0, 1.0)[:, None]], 1)


def _in_plane(vectors: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Unit vectors (N, 3), without their part along unit normals; zero where nothing is left."""
    rest = vectors - (vectors * normals).sum(1, keepdims=True) * normals
    length = np.linalg.norm(rest, axis=1, keepdims=True)
    kept = length > 1e-9 * np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(kept, rest / np.where(kept, length, 1), 0.0)


def _beside(normals: np.ndarray) -> np.ndarray:
    """(N, 3) vectors in directions that those of normals are not near to."""
    return np.where(np.abs(normals[:, :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
