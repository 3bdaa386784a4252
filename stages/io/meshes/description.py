"""What a mesh file holds, in figures."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from pipeline.errors import BadInput
from stages.io.meshes.geometry import Damaged, Geometry, opened
from stages.io.meshes.glb import Glb
from stages.io.meshes.ply import read_ply
from stages.io.meshes.text import read_obj, read_stl, read_xyz

READERS = {".ply": read_ply, ".obj": read_obj, ".stl": read_stl, ".xyz": read_xyz}
MESHES = (".glb", *READERS)  # what can be described


def describe_mesh(path: Path) -> dict[str, Any]:
    """Vertices, faces (as triangles), bounds and, of faces, whether they are watertight; of a GLB with meshes that are placed several times each mesh once, and
    how often they are placed. Raises BadInput."""
    suffix = path.suffix.lower()
    with opened(path) as (file, size):
        found = _glb(file, size) if suffix == ".glb" else _facts([(READERS[suffix](file, size), [np.eye(4)])])
    if not found["vertices"]:
        raise BadInput(f"{path}: holds no vertices.")
    return found


def _glb(file: BinaryIO, size: int) -> dict[str, Any]:
    glb = Glb(file, size)
    try:
        placed = glb.meshes()
        found = _facts((glb.geometry(mesh), matrices) for mesh, matrices in placed.items())
    except (KeyError, IndexError, TypeError, AttributeError) as error:
        raise Damaged(f"a glTF document that is not as it has to be ({type(error).__name__})") from error
    instances = sum(map(len, placed.values()))
    return {**found, "instances": instances} if instances > len(placed) else found


def _facts(parts: Iterable[tuple[Geometry, list[np.ndarray]]]) -> dict[str, Any]:
    """Of geometries, one at a time, and where each is placed."""
    vertices, faces, watertight = 0, 0, True
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for geometry, matrices in parts:
        vertices += len(geometry.vertices)
        faces += len(geometry.triangles)
        watertight &= not len(geometry.triangles) or geometry.is_watertight()
        for least, greatest in _bounds(geometry.vertices, matrices):
            low, high = np.minimum(low, least), np.maximum(high, greatest)
    bounds = [low.tolist(), high.tolist()] if np.isfinite([low, high]).all() else None  # None: some are no numbers
    return {"vertices": vertices, "faces": faces, "bounds": bounds} | ({"watertight": watertight} if faces else {})


def _bounds(vertices: np.ndarray, matrices: list[np.ndarray]) -> list[np.ndarray]:
    """The least and the greatest places, (2, 3) for each place of a mesh: where there are several, of its box, so that vertices are gone through once."""
    if not len(vertices):
        return []
    if len(matrices) > 1:
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        vertices = np.array([[(low, high)[bits >> axis & 1][axis] for axis in range(3)] for bits in range(8)])
    found = []
    with np.errstate(all="ignore"):
        for matrix in matrices:
            placed = vertices @ matrix[:3, :3].T + matrix[:3, 3]
            found.append(np.stack([placed.min(axis=0), placed.max(axis=0)]))
    return found
