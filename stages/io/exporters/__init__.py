"""Meshes and points as files, one module per format. The tables say which formats there are, by extension.

Every exporter is called as `write(what, path, frame)`: a mesh or points in the capture's frame, the file, and what is known of that frame.
It raises BadInput, before anything is written, for what would make a broken file.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from efficientnerf.surface.mesh import Mesh, PointCloud
    from stages.io.exporters.writing import SourceFrame


def _of(module: str, function: str) -> Callable[[Any, Path, SourceFrame], None]:
    """The function of a module of this package, imported when it is called."""

    def write(what: Any, path: Path, frame: SourceFrame) -> None:
        getattr(import_module(f"{__name__}.{module}"), function)(what, path, frame)

    return write


def _mesh(module: str) -> Callable[[Mesh, Path, SourceFrame], None]:
    return _of(module, "write_mesh")


def _points(module: str) -> Callable[[PointCloud, Path, SourceFrame], None]:
    return _of(module, "write_points")


MESH_EXPORTERS = {".ply": _mesh("ply"), ".glb": _mesh("glb"), ".obj": _mesh("obj")}
POINT_EXPORTERS = {".ply": _points("ply"), ".xyz": _points("xyz")}
