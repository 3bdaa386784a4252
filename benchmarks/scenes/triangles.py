"""Triangle meshes of the shapes of a scene: the truth that surfaces are measured against."""

from collections.abc import Iterable

import numpy as np
import trimesh

from benchmarks.scenes.shapes import Box, Capsule, Disc, Ground, Shape, Sphere

AROUND = 24  # sides of a capsule or a disc
GROUND = 6.0  # half side of the piece of ground


def triangles(shape: Shape) -> trimesh.Trimesh:
    """A mesh of one shape; of round ones the vertices lie on it."""
    if isinstance(shape, Sphere):
        return trimesh.creation.icosphere(subdivisions=4, radius=shape.radius).apply_translation(shape.centre)
    if isinstance(shape, Box):
        box = trimesh.creation.box(2 * np.array(shape.half))
        return trimesh.Trimesh(np.asarray(box.vertices) @ shape.rotation.T + shape.centre, box.faces, process=False)
    if isinstance(shape, Capsule):
        a, b = np.array(shape.a), np.array(shape.b)
        rod = trimesh.creation.capsule(height=float(np.linalg.norm(b - a)), radius=shape.radius, count=(12, AROUND))
        lowest = np.asarray(rod.vertices)[:, 2].min()
        rod.apply_translation([0, 0, -shape.radius - lowest])  # its axis begins at the origin
        rod.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], b - a))
        return rod.apply_translation(a)
    if isinstance(shape, Disc):
        angle = 2 * np.pi * np.arange(AROUND) / AROUND
        rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(AROUND)], -1) * shape.radius
        disc = trimesh.Trimesh(np.concatenate([rim, np.zeros((1, 3))]), [[n, (n + 1) % AROUND, AROUND] for n in range(AROUND)], process=False)
        disc.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], shape.unit))
        return disc.apply_translation(shape.centre)
    if not isinstance(shape, Ground):
        raise TypeError(f"{type(shape).__name__} has no triangles")
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * GROUND + [0, 0, shape.height]
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def mesh_of(shapes: Iterable[Shape]) -> trimesh.Trimesh:
    """All shapes as one mesh; they may reach into each other."""
    return trimesh.util.concatenate([triangles(shape) for shape in shapes])
