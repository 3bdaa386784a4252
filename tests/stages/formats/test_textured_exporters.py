"""Meshes with a texture in every format: read back by small parsers of the tests' own (and USD's library), the same surface in the same colours."""

import io
import os
import struct
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from efficientnerf.surface.mesh import Mesh, Texture
from pipeline.errors import BadInput
from stages.formats.exporters import MESH_EXPORTERS
from stages.formats.exporters.textures import open_faces
from tests.stages.io.meshes import NEEDS_USD, Y_DOWN, Z_UP, accessor, block, glb_document

SIDE = 48


def textured() -> Mesh:
    """The block with each of its six sides in a cell of an atlas, which is 3 wide and 2 high."""
    quad = 0.05 + 0.9 * np.array([(0.0, 0), (0, 1), (1, 1), (1, 0)])
    cells = [(np.array([k % 3, k // 3]) + quad) / [3, 2] for k in range(6)]
    coordinates = np.array([part for cell in cells for part in (cell[[0, 1, 2]], cell[[0, 2, 3]])])
    y, x = np.mgrid[0:SIDE, 0:SIDE] / SIDE
    colours = np.stack([255 * x, 255 * y, 128 + 100 * np.sin(20 * x) * np.cos(14 * y)], -1).astype(np.uint8)
    return replace(block(), texture=Texture(coordinates, colours))


# corners (F, 3, 3) in the capture's frame, texture coordinates (F, 3, 2) with v up, the picture
Read = tuple[np.ndarray, np.ndarray, np.ndarray]


def picture_of(data: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(data)))


def read_glb(path: Path) -> Read:
    document, blob = glb_document(path)
    assert all(view["byteOffset"] % 4 == 0 for view in document["bufferViews"])
    primitive = document["meshes"][0]["primitives"][0]
    assert sorted(primitive["attributes"]) == ["NORMAL", "POSITION", "TEXCOORD_0"], "colours of vertices would darken the texture"
    vertices, places = (accessor(document, blob, primitive["attributes"][name]) for name in ("POSITION", "TEXCOORD_0"))
    faces = accessor(document, blob, primitive["indices"]).reshape(-1, 3)
    back = np.array(document["nodes"][0]["extras"]["source_frame"]["gltf_from_capture"])[:3, :3]
    view = document["bufferViews"][document["images"][0]["bufferView"]]
    picture = picture_of(blob[view["byteOffset"] : view["byteOffset"] + view["byteLength"]])
    material = document["materials"][0]
    assert document["textures"][material["pbrMetallicRoughness"]["baseColorTexture"]["index"]]["source"] == 0
    assert "KHR_materials_unlit" in material["extensions"]
    assert document["extensionsUsed"] == ["KHR_materials_unlit"]
    return (vertices @ back)[faces], (places * [1, -1] + [0, 1])[faces], picture


def read_obj(path: Path) -> Read:
    lines = [line.split() for line in path.read_text("ascii").splitlines()]
    vertices, places = (np.array([line[1:] for line in lines if line[0] == name], float) for name in ("v", "vt"))
    corners = np.array([[part.split("/") for part in line[1:]] for line in lines if line[0] == "f"], int) - 1
    (library,) = [line[1:] for line in lines if line[0] == "mtllib"]
    assert len(library) == 1, "readers part names at blanks"
    material = {line.split()[0]: line.split()[1:] for line in path.with_name(library[0]).read_text("ascii").splitlines()}
    (used,) = [line[1:] for line in lines if line[0] == "usemtl"]
    assert material["newmtl"] == used
    (colours,) = material["map_Kd"]
    return vertices[corners[..., 0]], places[corners[..., 1]], picture_of(path.with_name(colours).read_bytes())


def read_usd(path: Path) -> Read:
    from pxr import Ar, Usd, UsdGeom, UsdShade

    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert stage.HasAuthoredMetadata("metersPerUnit")
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    shape = UsdGeom.Mesh(stage.GetPrimAtPath("/surface/mesh"))
    back = np.array(stage.GetRootLayer().customLayerData["usdFromCapture"]).reshape(3, 3)
    faces = np.array(shape.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    st = UsdGeom.PrimvarsAPI(shape).GetPrimvar("st")
    places = np.array(st.ComputeFlattened()).reshape(-1, 3, 2)
    surface = UsdShade.Shader(stage.GetPrimAtPath("/surface/material/surface"))
    source = UsdShade.Shader(surface.GetInput("emissiveColor").GetConnectedSources()[0][0].source.GetPrim())
    asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(source.GetInput("file").Get().resolvedPath))
    return (np.array(shape.GetPointsAttr().Get()) @ back)[faces], places, picture_of(bytes(asset.GetBuffer()))


READERS: dict[str, Callable[[Path], Read]] = {".glb": read_glb, ".obj": read_obj, ".usdz": read_usd, ".usdc": read_usd}
TEXTURED = [pytest.param(each, marks=NEEDS_USD) if each.startswith(".usd") else each for each in READERS]


@pytest.mark.parametrize("picture", ["png", "jpeg"])
@pytest.mark.parametrize("extension", TEXTURED)
def test_the_same_surface_in_the_same_colours(extension: str, picture: str, tmp_path: Path) -> None:
    mesh, path = textured(), tmp_path / f"thing{extension}"
    exporter = MESH_EXPORTERS[extension]
    exporter(mesh, path, Y_DOWN, picture=picture)
    corners, places, colours = READERS[extension](path)
    np.testing.assert_allclose(corners, mesh.vertices[mesh.faces], atol=1e-5)
    np.testing.assert_allclose(places, mesh.texture.coordinates, atol=1e-6)
    if picture == "png":
        np.testing.assert_array_equal(colours, mesh.texture.colours)
    else:
        assert 30 < -10 * np.log10(((colours / 255.0 - mesh.texture.colours / 255.0) ** 2).mean()) < 70
    written = sorted(each.name for each in tmp_path.iterdir())
    assert written == sorted([path.name, *(each.name for each in exporter.companions(path, picture))])


@pytest.mark.parametrize("extension", [pytest.param(each, marks=NEEDS_USD) if each.startswith(".usd") else each for each in MESH_EXPORTERS])
def test_the_same_mesh_is_the_same_bytes(extension: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On another day, elsewhere on the earth, in another folder."""
    found = []
    for name, zone in (("one", "UTC"), ("two", "Asia/Tokyo")):
        monkeypatch.setenv("TZ", zone)
        (tmp_path / name).mkdir()
        MESH_EXPORTERS[extension](textured(), tmp_path / name / f"thing{extension}", Z_UP)
        os.utime(tmp_path / name / f"thing{extension}", (1e9, 1e9))
        found.append([each.read_bytes() for each in sorted((tmp_path / name).iterdir())])
    assert found[0] == found[1]


def test_open_meshes_are_seen_from_both_sides(tmp_path: Path) -> None:
    closed = textured()
    part = replace(closed, faces=closed.faces[:-1], texture=replace(closed.texture, coordinates=closed.texture.coordinates[:-1]))
    assert (open_faces(closed.faces), open_faces(part.faces)) == (False, True)
    for mesh, expected in ((closed, False), (part, True)):
        MESH_EXPORTERS[".glb"](mesh, tmp_path / "a.glb", Z_UP)
        assert glb_document(tmp_path / "a.glb")[0]["materials"][0].get("doubleSided", False) == expected


@NEEDS_USD
def test_usdz_is_a_zip_of_aligned_stored_files_without_dates(tmp_path: Path) -> None:
    path = tmp_path / "a.usdz"
    MESH_EXPORTERS[".usdz"](textured(), path, Z_UP)
    data = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        assert [entry.filename for entry in archive.infolist()] == ["surface.usdc", "surface.png"]
        for entry in archive.infolist():
            name, extra = struct.unpack_from("<HH", data, entry.header_offset + 26)
            assert (entry.header_offset + 30 + name + extra) % 64 == 0
            assert entry.compress_type == zipfile.ZIP_STORED
            assert entry.date_time == (1980, 1, 1, 0, 0, 0)
        assert archive.testzip() is None


@NEEDS_USD
@pytest.mark.parametrize("mesh", [block(), textured()], ids=["vertex colours", "texture"])
def test_usds_own_validators_find_nothing(mesh: Mesh, tmp_path: Path) -> None:
    from pxr import Usd, UsdValidation

    path = tmp_path / "a.usdz"
    MESH_EXPORTERS[".usdz"](mesh, path, Z_UP)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10
    errors = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(path)))
    assert [error.GetMessage() for error in errors] == []


@pytest.mark.parametrize(("function", "call"), [("fsync", 0), ("fsync", 3), ("replace", 0), ("replace", 2)])
def test_a_full_disk_leaves_no_part_of_an_obj(function: str, call: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of three files, whichever cannot be written or renamed; the fourth call to sync is of the folder."""
    calls, real = iter(range(100)), getattr(os, function)

    def full(*arguments: object, **more: object) -> object:
        if next(calls) == call:
            raise OSError(28, "No space left on device")
        return real(*arguments, **more)

    monkeypatch.setattr(os, function, full)
    with pytest.raises(OSError, match="Errno 28"):
        MESH_EXPORTERS[".obj"](textured(), tmp_path / "a.obj", Z_UP)
    assert list(tmp_path.iterdir()) == []


def spoilt(**changes: np.ndarray) -> Mesh:
    mesh = textured()
    assert mesh.texture is not None
    return replace(mesh, texture=replace(mesh.texture, **changes))


BROKEN = {
    "nan": spoilt(coordinates=np.full((12, 3, 2), np.nan)),
    "another mesh's": spoilt(coordinates=np.zeros((11, 3, 2))),
    "outside": spoilt(coordinates=np.full((12, 3, 2), 1.5)),
    "floating": spoilt(colours=np.zeros((4, 4, 3))),
    "grey": spoilt(colours=np.zeros((4, 4), np.uint8)),
    "empty": spoilt(colours=np.zeros((0, 4, 3), np.uint8)),
    "too large": spoilt(colours=np.broadcast_to(np.uint8(0), (20000, 20000, 3))),
    "with opacity": spoilt(colours=np.zeros((4, 4, 4), np.uint8)),
}


@pytest.mark.parametrize("extension", [".glb", ".obj", ".usdz"])
def test_broken_textures_are_refused(extension: str, tmp_path: Path) -> None:
    for mesh in BROKEN.values():
        with pytest.raises(BadInput, match=r"texture|coordinates"):
            MESH_EXPORTERS[extension](mesh, tmp_path / f"a{extension}", Z_UP)
    assert list(tmp_path.iterdir()) == []
