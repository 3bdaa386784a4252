"""Meshes, points, volumes and 3D Gaussians as files, one module per format. The tables say which formats there are, by extension.

Every exporter is called as `write(what, path, frame)`: a mesh, points or Gaussians in the capture's frame, the file, and what is known of that frame; those
of meshes whose format keeps textures take `picture`, "png" or "jpeg", too; those of volumes take the asset. It raises BadInput, before anything is written,
for what would make a broken file.
"""

from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pipeline.errors import UsageError

_PACKAGES = {"usd": {"pxr": "usd-core"}, "las": {"laspy": "laspy", "lazrs": "lazrs"}}  # extra -> modules that it installs -> their packages


@dataclass(frozen=True)
class Format:
    """What a format of meshes, of points, of volumes or of Gaussians is."""

    extension: str  # with its dot
    keeps: str  # of a mesh, of points or of an asset
    loses: str  # what it has no place for
    opened_by: str  # programs that were tried; after "should", others that were not
    module: str  # of this package, and its function: write
    function: str
    textures: bool = False  # whether it keeps textures, and takes `picture`
    coloured: bool = True  # whether it keeps colours at all: of vertices, which a mesh with a texture takes from that
    extra: str | None = None  # of the package efficientnerf, that has to be installed for it
    companion_files: bool = False  # whether a texture lies in files next to it: `companions` of its module

    def __call__(self, what: Any, path: Path, frame: Any, **options: Any) -> None:
        """Write it. `options`: picture, of formats that keep textures; version, of .spz. The module is imported now. Raises BadInput and UsageError."""
        self.refuse_without_package(path)
        getattr(import_module(f"{__name__}.{self.module}"), self.function)(what, path, frame, **options)

    def companions(self, path: Path, picture: str = "png") -> list[Path]:
        """The files that it writes next to `path` where the mesh has a texture."""
        found: list[Path] = import_module(f"{__name__}.{self.module}").companions(path, picture) if self.companion_files else []
        return found

    def refuse_without_package(self, path: Path) -> None:
        """UsageError where a package is missing that writes it."""
        for module, package in _PACKAGES.get(self.extra or "", {}).items():
            if find_spec(module) is None:
                kind, how = str(self.extra).upper(), f"pip install 'efficientnerf[{self.extra}]'"
                raise UsageError(f"{path}: {kind} is written by the package {package}, which is not installed. Install it: {how}")


_MESHES = (
    Format(".ply", "shape, normals, colours of vertices; the capture's frame", "the texture",
           "trimesh; should: MeshLab, CloudCompare, Blender", "ply", "write_mesh"),
    Format(".glb", "shape, normals, texture or colours of vertices; y up; unlit", "the capture's axes (kept as a matrix in its extras)",
           "Blender, trimesh; should: Unity, Unreal, Godot, three.js, Windows", "glb", "write_mesh", textures=True),
    Format(".obj", "shape, normals, texture (a .mtl and an image next to it) or colours of vertices; the capture's frame", "that it is unlit",
           "Blender, trimesh; should: nearly everything", "obj", "write_mesh", textures=True, companion_files=True),
    Format(".usdz", "shape, normals, texture or colours of vertices, in one file; y up; unlit", "the capture's axes (kept as a matrix)",
           "Blender, OpenUSD; should: iOS and macOS, Houdini, Omniverse", "usd", "write_usdz", textures=True, extra="usd"),
    Format(".usdc", "the same, its image next to it", "the capture's axes (kept as a matrix)",
           "OpenUSD; should: Blender, Houdini, Omniverse, Maya", "usd", "write_usdc", textures=True, extra="usd", companion_files=True),
    Format(".stl", "shape; the capture's frame", "colours, texture, shared vertices", "trimesh; should: slicers for 3D printing, CAD",
           "stl", "write_mesh", coloured=False),
)  # fmt: skip
_POINTS = (
    Format(".ply", "places, normals, colours; the capture's frame", "nothing",
           "trimesh; should: MeshLab, CloudCompare, Blender", "ply", "write_points"),
    Format(".xyz", "places, colours, normals, as text; the capture's frame", "nothing",
           "numpy; should: CloudCompare, spreadsheets", "xyz", "write_points"),
    Format(".las", "places to a millionth of their reach, normals as extra dimensions, colours; the capture's frame", "nothing",
           "copc.js; should: CloudCompare, PDAL, QGIS, ArcGIS, Potree", "las", "write_points", extra="las"),
    Format(".laz", "the same, compressed", "nothing", "copc.js; should: CloudCompare, PDAL, QGIS, ArcGIS, Potree", "las", "write_points", extra="las"),
)  # fmt: skip
_VOLUMES = (
    Format(".vdb", "density and colour of each voxel, linear, sparse; the capture's frame",
           "the colours' change with the view; what lies beyond all voxels; forward-facing scenes", "OpenVDB of Blender; should: Houdini, Omniverse",
           "vdb", "write_volume"),
)  # fmt: skip

_SPLATS = (
    Format(".ply", "3D Gaussians with view-dependent colours, as 3DGS writes them; the capture's frame", "what fewer Gaussians than voxels cannot show",
           "PlayCanvas, Spark, three.js, splat-transform; should: whatever reads 3DGS", "splats.ply", "write_splats"),
    Format(".spz", "the same in an eighth of the bytes; y up", "precision: colours, sizes and opacities of 8 bits; the capture's axes",
           "splat-transform, of version 3 Spark, three.js; should: of version 4 PlayCanvas, three.js", "splats.spz", "write_splats"),
    Format(".sog", "the same in an eighth of the bytes or less; y down, as its programs have it",
           "precision: harmonics by a palette, colours, sizes and opacities of 8 bits; the capture's axes",
           "splat-transform; should: SuperSplat, PlayCanvas, Babylon.js, Spark", "splats.sog", "write_splats"),
    Format(".glb", "the same, in single precision (KHR_gaussian_splatting); y up; points where the extension is unknown",
           "the capture's axes (kept as a matrix in its extras)", "PlayCanvas, three.js (set its output to linear); should: others of the extension",
           "splats.gltf", "write_splats"),
)  # fmt: skip

MESH_EXPORTERS: dict[str, Format] = {each.extension: each for each in _MESHES}
POINT_EXPORTERS: dict[str, Format] = {each.extension: each for each in _POINTS}
VOLUME_EXPORTERS: dict[str, Format] = {each.extension: each for each in _VOLUMES}
SPLAT_EXPORTERS: dict[str, Format] = {each.extension: each for each in _SPLATS}
