"""Meshes and points as files, one module per format. The tables say which formats there are, by extension.

Every exporter is called as `write(what, path, frame)`: a mesh or points in the capture's frame, the file, and what is known of that frame.
It raises BadInput, before anything is written, for what would make a broken file.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from efficientnerf.surface.mesh import Mesh, PointCloud

from .glb import write_mesh as _glb_mesh
from .obj import write_mesh as _obj_mesh
from .ply import write_mesh as _ply_mesh
from .ply import write_points as _ply_points
from .writing import SourceFrame
from .xyz import write_points as _xyz_points

MESH_EXPORTERS: dict[str, Callable[[Mesh, Path, SourceFrame], None]] = {".ply": _ply_mesh, ".glb": _glb_mesh, ".obj": _obj_mesh}
POINT_EXPORTERS: dict[str, Callable[[PointCloud, Path, SourceFrame], None]] = {".ply": _ply_points, ".xyz": _xyz_points}
