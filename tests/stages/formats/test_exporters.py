"""One contract for all exporters of meshes and points: written by us, read by others, and the same."""

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from efficientnerf.surface.mesh import Mesh, PointCloud
from pipeline.errors import BadInput
from stages.formats.exporters import MESH_EXPORTERS, POINT_EXPORTERS
from stages.formats.exporters.writing import SourceFrame
from tests.stages.io.meshes import NEEDS_LAS, NEEDS_USD, Y_DOWN, Z_UP, accessor, block, glb_document


def cloud() -> PointCloud:
    mesh = block()
    return PointCloud(mesh.vertices, mesh.normals, mesh.colours)


Read = tuple[np.ndarray, np.ndarray | None, np.ndarray | None, np.ndarray | None]  # vertices, normals, colours (sRGB 0-1), faces; None: the format has none


def read_by_trimesh(path: Path) -> Read:
    import trimesh

    mesh = trimesh.load(path, process=False, maintain_order=True)
    if isinstance(mesh, trimesh.PointCloud):
        return np.asarray(mesh.vertices), np.asarray(mesh.metadata["_ply_raw"]["vertex"]["data"][["nx", "ny", "nz"]].tolist()), mesh.colors[:, :3] / 255, None
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(6)
    return np.asarray(mesh.vertices), np.asarray(mesh.vertex_normals), mesh.visual.vertex_colors[:, :3] / 255, np.asarray(mesh.faces)


def read_glb(path: Path) -> Read:
    document, blob = glb_document(path)
    primitive = document["meshes"][0]["primitives"][0]
    vertices, normals, colours = (accessor(document, blob, primitive["attributes"][name]) for name in ("POSITION", "NORMAL", "COLOR_0"))
    assert document["accessors"][primitive["attributes"]["POSITION"]]["min"] == vertices.min(0).tolist()
    assert document["accessors"][primitive["attributes"]["POSITION"]]["max"] == vertices.max(0).tolist()
    assert colours.dtype == np.uint16
    assert (colours[:, 3] == 65535).all()
    linear = colours[:, :3] / 65535
    srgb = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
    back = np.array(document["nodes"][0]["extras"]["source_frame"]["gltf_from_capture"])[:3, :3].T
    return vertices @ back.T, normals @ back.T, srgb, accessor(document, blob, primitive["indices"]).reshape(-1, 3)


def read_by_numpy(path: Path) -> Read:
    rows = np.loadtxt(path)
    return rows[:, :3], rows[:, 6:], rows[:, 3:6] / 255, None


def read_by_usd(path: Path) -> Read:
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    shape = UsdGeom.Mesh(stage.GetPrimAtPath("/surface/mesh"))
    back = np.array(stage.GetRootLayer().customLayerData["usdFromCapture"]).reshape(3, 3)
    linear = np.array(UsdGeom.PrimvarsAPI(shape).GetPrimvar("displayColor").Get())
    srgb = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
    faces = np.array(shape.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    return np.array(shape.GetPointsAttr().Get()) @ back, np.array(shape.GetNormalsAttr().Get()) @ back, srgb, faces


def read_by_laspy(path: Path) -> Read:
    import laspy

    read = laspy.read(path)
    assert (str(read.header.version), read.point_format.id) == ("1.4", 7)
    assert read.header.are_points_compressed == (path.suffix == ".laz")
    normals = np.stack([read[name] for name in ("NormalX", "NormalY", "NormalZ")], axis=1)
    return np.asarray(read.xyz), normals, np.stack([read.red, read.green, read.blue], axis=1) / 65535, None


READERS: dict[str, Callable[[Path], Read]] = {".ply": read_by_trimesh, ".obj": read_by_trimesh, ".glb": read_glb, ".xyz": read_by_numpy,
                                              ".usdz": read_by_usd, ".usdc": read_by_usd, ".las": read_by_laspy, ".laz": read_by_laspy}  # fmt: skip
EXTENSIONS = [pytest.param(each, marks=NEEDS_USD) if each.startswith(".usd") else each for each in MESH_EXPORTERS]


@pytest.mark.parametrize("frame", [Z_UP, Y_DOWN], ids=["z up", "y down"])
@pytest.mark.parametrize(
    ("table", "extension"),
    [
        *(pytest.param("mesh", each, marks=NEEDS_USD if each.startswith(".usd") else ()) for each in READERS if each in MESH_EXPORTERS),
        *(pytest.param("points", each, marks=NEEDS_LAS if POINT_EXPORTERS[each].extra else ()) for each in POINT_EXPORTERS),
    ],
)
def test_others_read_what_was_written(table: str, extension: str, frame: SourceFrame, tmp_path: Path) -> None:
    path, mesh = tmp_path / f"thing{extension}", block()
    if table == "mesh":
        MESH_EXPORTERS[extension](mesh, path, frame)
    else:
        POINT_EXPORTERS[extension](cloud(), path, frame)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the readers' own
        vertices, normals, colours, faces = READERS[extension](path)
    np.testing.assert_allclose(vertices, mesh.vertices, atol=1e-6)
    if normals is not None:
        np.testing.assert_allclose(normals, mesh.normals, atol=2e-5)
    if colours is not None:
        np.testing.assert_allclose(colours, mesh.colours, atol=2e-4 if extension in (".glb", ".usdz", ".usdc") else 0.5 / 255 + 1e-6)
    if table == "mesh":
        np.testing.assert_array_equal(faces, mesh.faces)
    assert [each.name for each in tmp_path.iterdir()] == [path.name]


def test_the_ply_header_is_the_agreed_one(tmp_path: Path) -> None:
    MESH_EXPORTERS[".ply"](block(), tmp_path / "a.ply", Y_DOWN)
    head, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert lines[2] == "comment frame of the capture; up 0 -1 0; unit metre"
    assert [line for line in lines if line.startswith("property")] == [
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        "property list uchar int vertex_indices",
    ]
    assert len(body) == 8 * 27 + 12 * 13


def test_glb_stands_upright_in_linear_light(tmp_path: Path) -> None:
    """The two mistakes that validators do not find, and the material that keeps lamps off."""
    MESH_EXPORTERS[".glb"](block(), tmp_path / "a.glb", Z_UP)
    document, blob = glb_document(tmp_path / "a.glb")
    x, y, z = block().vertices.T
    np.testing.assert_allclose(accessor(document, blob, 0), np.stack([x, z, -y], 1))
    np.testing.assert_allclose(accessor(document, blob, 2)[2, :3] / 65535, [0.21404, 0.05088, 0.52252], atol=2e-5)
    assert document["materials"][0]["extensions"] == {"KHR_materials_unlit": {}}
    assert document["extensionsUsed"] == ["KHR_materials_unlit"]
    assert document["nodes"][0]["extras"]["source_frame"]["unit"] == "unknown"


def spoilt(**changes: np.ndarray) -> Mesh:
    return replace(block(), **changes)


BROKEN = {
    "faces": spoilt(faces=np.zeros((0, 3), np.int64)),
    "1 of 8 vertices": spoilt(vertices=np.where(np.arange(8)[:, None] == 3, np.nan, block().vertices)),
    "vertices": spoilt(vertices=block().vertices * 1e39),
    "8 of 8 colours": spoilt(colours=np.full((8, 3), np.inf, np.float32)),
    "vertices 1 to 8": spoilt(faces=block().faces + 1),
}


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_broken_meshes_are_refused(extension: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{extension}"
    path.write_bytes(b"older")
    for named, mesh in BROKEN.items():
        with pytest.raises(BadInput, match=named):
            MESH_EXPORTERS[extension](mesh, path, Z_UP)
    assert path.read_bytes() == b"older"


@NEEDS_LAS
@pytest.mark.parametrize("frame", [Z_UP, Y_DOWN])
def test_las_and_stl_state_the_unit_that_is_known(frame: SourceFrame, tmp_path: Path) -> None:
    import laspy

    points = PointCloud(np.eye(3), np.eye(3), np.eye(3))
    POINT_EXPORTERS[".las"](points, tmp_path / "a.las", frame)
    MESH_EXPORTERS[".stl"](block(), tmp_path / "a.stl", frame)
    stated = [each.string for each in laspy.read(tmp_path / "a.las").header.vlrs.get("WktCoordinateSystemVlr")]
    assert [text.endswith('UNIT["metre",1]]') for text in stated] == ([True] if frame.metric else [])
    assert (tmp_path / "a.stl").read_bytes()[:80].rstrip().endswith(f"unit {frame.unit}".encode("ascii"))


@pytest.mark.parametrize("extension", POINT_EXPORTERS)
def test_broken_points_are_refused(extension: str, tmp_path: Path) -> None:
    empty = PointCloud(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3), np.float32))
    with pytest.raises(BadInput):
        POINT_EXPORTERS[extension](empty, tmp_path / "a", Z_UP)
    with pytest.raises(BadInput, match="normals"):
        POINT_EXPORTERS[extension](replace(cloud(), normals=np.full((8, 3), np.nan)), tmp_path / "a", Z_UP)


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_a_failed_write_leaves_what_was_there(extension: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / f"a{extension}"
    path.write_bytes(b"older")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="Errno 28"):
        MESH_EXPORTERS[extension](block(), path, Z_UP)
    assert [(each.name, each.read_bytes()) for each in tmp_path.iterdir()] == [(path.name, b"older")]
