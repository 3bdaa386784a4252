"""PLY, binary little endian: float32 x y z nx ny nz, uchar red green blue holding sRGB; meshes add the list vertex_indices. The capture's frame."""

from pathlib import Path

import numpy as np

from efficientnerf.surface.mesh import Mesh, PointCloud
from stages.formats.exporters.writing import CAPTURE_IS_Z_UP, SourceFrame, bytes_from_srgb, check_mesh, check_points, write_parts

VERTEX = np.dtype([*((name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")), *((name, "u1") for name in ("red", "green", "blue"))])
FACE = np.dtype([("count", "u1"), ("vertex_indices", "<i4", (3,))])
_NAMES = {"<f4": "float", "|u1": "uchar"}


def write_mesh(mesh: Mesh, path: Path, frame: SourceFrame = CAPTURE_IS_Z_UP) -> None:
    """Write a mesh in the capture's frame. Raises BadInput."""
    check_mesh(mesh, path)
    faces = np.empty(len(mesh.faces), FACE)
    faces["count"], faces["vertex_indices"] = 3, mesh.faces
    header = mesh_header(len(mesh.vertices), len(faces), frame)
    write_parts(path, [header.encode("ascii"), _vertices(mesh.vertices, mesh.normals, mesh.colours), faces.tobytes()])


def write_points(points: PointCloud, path: Path, frame: SourceFrame = CAPTURE_IS_Z_UP) -> None:
    """Write a point cloud in the capture's frame. Raises BadInput."""
    check_points(points, path)
    header = _header(len(points.positions), frame) + "end_header\n"
    write_parts(path, [header.encode("ascii"), _vertices(points.positions, points.normals, points.colours)])


def mesh_header(vertices: int, faces: int, frame: SourceFrame) -> str:
    """What stands before the rows of a mesh of so many vertices and faces."""
    return _header(vertices, frame) + f"element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"


def _header(count: int, frame: SourceFrame) -> str:
    properties = "".join(f"property {_NAMES[VERTEX[name].str]} {name}\n" for name in VERTEX.names or ())
    return f"ply\nformat binary_little_endian 1.0\ncomment {frame.comment}\nelement vertex {count}\n{properties}"


def _vertices(positions: np.ndarray, normals: np.ndarray, colours: np.ndarray) -> bytes:
    rows = np.empty(len(positions), VERTEX)
    for column, name in enumerate(("x", "y", "z")):
        rows[name], rows["n" + name] = positions[:, column], normals[:, column]
    for column, name in enumerate(("red", "green", "blue")):
        rows[name] = bytes_from_srgb(colours)[:, column]
    return rows.tobytes()
