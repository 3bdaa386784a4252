"""USD: USDC with the texture's picture next to it, or USDZ with it inside. Needs the package usd-core, which is the extra `usd`.

Axes     y up, turned as for GLB (`gltf_from_capture`); a unit is stated to be a metre, and in the layer's custom data whether that is known.
Light    UsdPreviewSurface that emits its colours and reflects nothing: they already hold the light of the capture.
Texture  the primvar `st`, of each face's corners; v counts from the lower edge. sRGB. Without a texture `displayColor`, which is linear.
Sides    a mesh with open edges is seen from both sides.

A USDZ is a zip whose files are stored as they are and begin at multiples of 64 bytes (OpenUSD, "Usdz File Format Specification"). It is written here and not
by UsdUtils.CreateNewUsdzPackage, which puts the local time into it: the same mesh is the same bytes.
"""

import errno
import io
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from efficientnerf.rendering.colour import linear_from_srgb
from efficientnerf.surface.mesh import Mesh
from stages.formats.exporters.glb import gltf_from_capture
from stages.formats.exporters.textures import Picture, companions, distinct_places, open_faces, picture_of
from stages.formats.exporters.writing import CAPTURE_IS_Z_UP, SourceFrame, check_mesh, write_files, write_parts

ALIGNMENT = 64  # bytes, of the beginnings of a package's files
LAYER = "surface.usdc"  # in a package
_PADDING = 0x1986  # the identifier of an extra field of a zip that holds nothing, as USD's own writer uses it


def write_usdc(mesh: Mesh, path: Path, frame: SourceFrame = CAPTURE_IS_Z_UP, picture: Picture = "png") -> None:
    """Write a mesh given in the capture's frame, and its pictures next to it. Raises BadInput."""
    check_mesh(mesh, path)
    texture, (name,) = picture_of(mesh, picture), companions(path, picture)
    files = {} if texture is None else {name: [texture]}
    write_files({**files, path: [_layer(mesh, frame, None if texture is None else name.name)]})


def write_usdz(mesh: Mesh, path: Path, frame: SourceFrame = CAPTURE_IS_Z_UP, picture: Picture = "png") -> None:
    """Write a mesh given in the capture's frame as one package. Raises BadInput."""
    check_mesh(mesh, path)
    texture, (name,) = picture_of(mesh, picture), companions(Path(LAYER), picture)
    files = {} if texture is None else {name.name: texture}
    write_parts(path, [package({LAYER: _layer(mesh, frame, None if texture is None else name.name), **files})])


def package(files: Mapping[str, bytes]) -> bytes:
    """A USDZ of these files; the first is its root layer."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        for name, data in files.items():
            entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
            entry.create_system, entry.external_attr = 0, 0
            begin = out.tell() + 30 + len(name.encode()) + 4  # local header, name, the head of the extra field
            padding = -begin % ALIGNMENT
            entry.extra = _PADDING.to_bytes(2, "little") + padding.to_bytes(2, "little") + bytes(padding)
            archive.writestr(entry, data)
    return out.getvalue()


def _layer(mesh: Mesh, frame: SourceFrame, picture: str | None) -> bytes:
    """The layer as a binary file; `picture` is the file next to it that it refers to."""
    from pxr import Tf, Usd, UsdGeom, Vt  # an extra

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    rotation = gltf_from_capture(frame.up)
    layer = stage.GetRootLayer()
    layer.customLayerData = {
        "creator": "efficientnerf", "unit": frame.unit, "captureUp": Vt.DoubleArray((frame.up + 0.0).tolist()),
        "usdFromCapture": Vt.DoubleArray((rotation + 0.0).reshape(-1).tolist()),
    }  # fmt: skip
    root = UsdGeom.Xform.Define(stage, "/surface")
    Usd.ModelAPI(root).SetKind("component")
    stage.SetDefaultPrim(root.GetPrim())
    shape = UsdGeom.Mesh.Define(stage, "/surface/mesh")
    _put_geometry(shape, mesh, rotation)
    _put_material(stage, shape, picture)
    with TemporaryDirectory() as folder:
        target = os.path.join(folder, LAYER)
        try:
            if not layer.Export(target):
                raise OSError(errno.EIO, os.strerror(errno.EIO), target)
        except Tf.ErrorException as error:  # USD has one for everything
            number = errno.EIO if os.statvfs(folder).f_bavail else errno.ENOSPC
            raise OSError(number, os.strerror(number), target) from error
        return Path(target).read_bytes()


def _put_geometry(shape: Any, mesh: Mesh, rotation: np.ndarray) -> None:
    """Vertices, faces, normals, and texture coordinates or colours."""
    from pxr import Sdf, UsdGeom, Vt  # an extra

    vertices = np.ascontiguousarray(mesh.vertices @ rotation.T, np.float32)
    normals = mesh.normals @ rotation.T
    shape.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(vertices))
    shape.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([vertices.min(0), vertices.max(0)])))
    shape.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    shape.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.faces.reshape(-1), np.int32)))
    shape.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(normals / np.linalg.norm(normals, axis=1, keepdims=True), np.float32)))
    shape.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    shape.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    shape.CreateDoubleSidedAttr(open_faces(mesh.faces))
    primvars = UsdGeom.PrimvarsAPI(shape)
    if mesh.texture is None:
        linear = np.ascontiguousarray(linear_from_srgb(np.clip(mesh.colours.astype(np.float32), 0, 1)))
        primvars.CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.vertex).Set(Vt.Vec3fArray.FromNumpy(linear))
        return
    places, number = distinct_places(mesh.texture)
    st = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
    st.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(places)))
    st.SetIndices(Vt.IntArray.FromNumpy(np.ascontiguousarray(number.ravel(), np.int32)))


def _put_material(stage: Any, shape: Any, picture: str | None) -> None:
    """UsdPreviewSurface, bound to the mesh."""
    from pxr import Gf, Sdf, UsdShade  # an extra

    def shader(name: str, kind: str) -> Any:
        made = UsdShade.Shader.Define(stage, f"/surface/material/{name}")
        made.CreateIdAttr(kind)
        return made

    kinds = Sdf.ValueTypeNames
    material = UsdShade.Material.Define(stage, "/surface/material")
    surface = shader("surface", "UsdPreviewSurface")
    for name, value in (("roughness", 1.0), ("metallic", 0.0), ("ior", 1.0)):
        surface.CreateInput(name, kinds.Float).Set(value)
    surface.CreateInput("diffuseColor", kinds.Color3f).Set(Gf.Vec3f(0.0))
    surface.CreateInput("useSpecularWorkflow", kinds.Int).Set(1)
    surface.CreateInput("specularColor", kinds.Color3f).Set(Gf.Vec3f(0.0))
    colour = surface.CreateInput("emissiveColor", kinds.Color3f)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", kinds.Token))
    UsdShade.MaterialBindingAPI.Apply(shape.GetPrim()).Bind(material)
    if picture is None:
        vertex = shader("vertex_colours", "UsdPrimvarReader_float3")
        vertex.CreateInput("varname", kinds.String).Set("displayColor")
        colour.ConnectToSource(vertex.CreateOutput("result", kinds.Float3))
        return
    place = shader("place", "UsdPrimvarReader_float2")
    place.CreateInput("varname", kinds.String).Set("st")
    result = place.CreateOutput("result", kinds.Float2)
    texture = shader("colours", "UsdUVTexture")
    texture.CreateInput("file", kinds.Asset).Set(Sdf.AssetPath(f"./{picture}"))
    texture.CreateInput("st", kinds.Float2).ConnectToSource(result)
    texture.CreateInput("sourceColorSpace", kinds.Token).Set("sRGB")
    for axis in ("wrapS", "wrapT"):
        texture.CreateInput(axis, kinds.Token).Set("clamp")
    colour.ConnectToSource(texture.CreateOutput("rgb", kinds.Float3))
