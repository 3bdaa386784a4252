"""Wavefront OBJ as text: `v x y z r g b` with sRGB colours 0-1 (the extension that most readers know), `vn`, `f v//vn`. The capture's frame."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from efficientnerf.surface.mesh import Mesh
from stages.io.exporters.writing import CAPTURE_IS_Z_UP, SourceFrame, check_mesh, write_parts

_ROWS = 50_000  # lines made at a time


def write_mesh(mesh: Mesh, path: Path, frame: SourceFrame = CAPTURE_IS_Z_UP) -> None:
    """Write a mesh in the capture's frame. Raises BadInput."""
    check_mesh(mesh, path)
    write_parts(path, _text(mesh, frame))


def _text(mesh: Mesh, frame: SourceFrame) -> Iterator[bytes]:
    up = " ".join(f"{value:.9g}" for value in frame.up + 0.0)
    yield f"# frame of the capture; up {up}; unit {'metre' if frame.metric else 'unknown'}; colours sRGB\n".encode("ascii")
    yield from _lines("v %.9g %.9g %.9g %.4f %.4f %.4f\n", np.hstack([mesh.vertices, np.clip(mesh.colours, 0, 1)]))
    yield from _lines("vn %.5f %.5f %.5f\n", mesh.normals)
    yield from _lines("f %d//%d %d//%d %d//%d\n", np.repeat(mesh.faces + 1, 2, axis=1))


def _lines(form: str, rows: np.ndarray) -> Iterator[bytes]:
    for start in range(0, len(rows), _ROWS):
        part = rows[start : start + _ROWS]
        yield (form * len(part) % tuple(part.ravel().tolist())).encode("ascii")
