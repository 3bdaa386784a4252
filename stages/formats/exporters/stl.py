"""STL, binary: the faces alone, each with its normal, float32. No colours. The capture's frame, whose unit the header states."""

from pathlib import Path

import numpy as np

from efficientnerf.surface.mesh import Mesh, face_vectors
from stages.formats.exporters.writing import CAPTURE_IS_Z_UP, SourceFrame, check_mesh, write_parts

_FACE = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEADER = "binary STL of efficientnerf; frame of the capture; unit {unit}"  # must not begin with "solid", as text does


def write_mesh(mesh: Mesh, path: Path, frame: SourceFrame = CAPTURE_IS_Z_UP) -> None:
    """Write a mesh in the capture's frame. Raises BadInput."""
    check_mesh(mesh, path)
    vectors = face_vectors(mesh.vertices, mesh.faces)
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    faces = np.zeros(len(mesh.faces), _FACE)
    faces["normal"] = vectors / np.where(length > 0, length, 1)
    faces["corners"] = mesh.vertices[mesh.faces]
    write_parts(path, [_HEADER.format(unit=frame.unit).encode("ascii").ljust(80), np.uint32(len(faces)).astype("<u4").tobytes(), faces.tobytes()])
