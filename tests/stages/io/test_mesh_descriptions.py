"""What `inspect` says of mesh files: as another library reads them, in memory that the file's size bounds, whatever a file says of itself."""

import copy
import struct
import time
import tracemalloc
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from efficientnerf.surface.mesh import PointCloud
from pipeline.errors import BadInput
from stages.formats.exporters import MESH_EXPORTERS, POINT_EXPORTERS
from stages.io.meshes.description import MESHES, describe_mesh
from tests.stages.io.meshes import Y_DOWN, block, glb_bytes
from workflows.cli.main import main

TIMES, ROOM = 16, 4_000_000  # of the file's bytes, and more, that describing a file may take


def box_glb(**nodes: Any) -> tuple[dict[str, Any], bytes]:
    """A box of 12 triangles, in a scene of one node that has what is given."""
    box = trimesh.creation.box((1, 2, 3))
    vertices, faces = np.asarray(box.vertices, "<f4"), np.asarray(box.faces, "<u2")
    views = [{"buffer": 0, "byteLength": vertices.nbytes}, {"buffer": 0, "byteOffset": vertices.nbytes, "byteLength": faces.nbytes}]
    accessors = [{"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3"}, {"bufferView": 1, "componentType": 5123, "count": 36, "type": "SCALAR"}]
    document = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0, **nodes}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}], "accessors": accessors, "bufferViews": views,
        "buffers": [{"byteLength": vertices.nbytes + faces.nbytes}],
    }  # fmt: skip
    return document, vertices.tobytes() + faces.tobytes()


def described(path: Path, data: bytes) -> dict[str, Any]:
    path.write_bytes(data)
    return describe_mesh(path)


@pytest.mark.parametrize("suffix", sorted(MESHES))
def test_it_says_what_another_library_reads(tmp_path: Path, suffix: str) -> None:
    path, mesh = tmp_path / f"a{suffix}", block()
    if suffix in MESH_EXPORTERS:
        MESH_EXPORTERS[suffix](mesh, path, Y_DOWN)
    else:
        POINT_EXPORTERS[suffix](PointCloud(mesh.vertices, mesh.normals, mesh.colours), path, Y_DOWN)
    found, other = describe_mesh(path), trimesh.load(path, process=False)
    other = other.to_geometry() if isinstance(other, trimesh.Scene) else other
    assert (found["vertices"], found["faces"]) == (len(other.vertices), len(getattr(other, "faces", ())))
    np.testing.assert_allclose(found["bounds"], other.bounds, atol=1e-6)
    assert found.get("watertight") is (True if suffix in MESH_EXPORTERS else None)


def test_nodes_place_meshes_and_instances_are_counted(tmp_path: Path) -> None:
    document, data = box_glb()
    half = 2**-0.5
    turned = {"translation": [0, 0, 10], "rotation": [half, 0, 0, half], "scale": [2, 1, 1]}  # x doubled, then z for y
    moved = {"matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 0, 0, 1], "children": [3]}
    document["nodes"] = [{"children": [1, 2]}, {"mesh": 0, **turned}, moved, {"mesh": 0}, {"mesh": 0}]
    found = described(tmp_path / "a.glb", glb_bytes(document, data))
    assert (found["vertices"], found["faces"], found["instances"], found["watertight"]) == (8, 12, 2, True)
    np.testing.assert_allclose(found["bounds"], [[-1, -1.5, -1.5], [5.5, 1.5, 11]], atol=1e-6)
    one = copy.deepcopy(document)
    one["nodes"] = [{"mesh": 0, **turned}]
    found = described(tmp_path / "a.glb", glb_bytes(one, data))
    assert "instances" not in found
    np.testing.assert_allclose(found["bounds"], [[-1, -1.5, 9], [1, 1.5, 11]], atol=1e-6)
    path = tmp_path / "b.glb"
    path.write_bytes(glb_bytes(document, data))
    np.testing.assert_allclose(trimesh.load(path, process=False).bounds, [[-1, -1.5, -1.5], [5.5, 1.5, 11]], atol=1e-6)


def hostile_glbs() -> dict[str, Callable[[], bytes]]:
    def changed(change: Callable[[dict[str, Any]], object], more: int = 0) -> Callable[[], bytes]:
        def made() -> bytes:
            document, data = box_glb()
            change(document)
            return glb_bytes(document, data + bytes(more))

        return made

    place, corners, view = (lambda d: d["accessors"][0]), (lambda d: d["accessors"][1]), (lambda d: d["bufferViews"][0])
    huge = 100_000_000
    return {
        "no view and a huge count": changed(lambda d: (place(d).pop("bufferView"), place(d).update(count=huge))),
        "a huge count": changed(lambda d: place(d).update(count=huge)),
        "a count below 0": changed(lambda d: place(d).update(count=-1)),
        "a count that is no number": changed(lambda d: place(d).update(count=8.5)),
        "a view beyond the binary part": changed(lambda d: view(d).update(byteOffset=huge)),
        "a view longer than the binary part": changed(lambda d: (view(d).update(byteLength=huge), place(d).update(count=5000))),
        "rows on top of each other": changed(lambda d: (view(d).update(byteStride=1), place(d).update(count=80))),
        "rows far apart": changed(lambda d: view(d).update(byteStride=4096)),
        "sparse": changed(lambda d: place(d).update(sparse={"count": 1})),
        "another buffer": changed(lambda d: view(d).update(buffer=1)),
        "a buffer of another file": changed(lambda d: d["buffers"][0].update(uri="/etc/passwd")),
        "a buffer in the text": changed(lambda d: d["buffers"][0].update(uri="data:application/octet-stream;base64,AAAA")),
        "numbers of another type": changed(lambda d: place(d).update(componentType=5130)),
        "vertices counted from the end": changed(lambda d: d["meshes"][0]["primitives"][0]["attributes"].update(POSITION=-2)),
        "indices as places": changed(lambda d: d["meshes"][0]["primitives"][0].update(indices=0)),
        "fractions as indices": changed(lambda d: corners(d).update(componentType=5126, count=9)),
        "fewer vertices than indices": changed(lambda d: place(d).update(count=3)),
        "a node of itself": changed(lambda d: d["nodes"][0].update(children=[0])),
        "a node with two parents": changed(lambda d: d.update(nodes=[{"children": [k + 1, k + 1]} for k in range(40)] + [{"mesh": 0}])),
        "a mesh counted from the end": changed(lambda d: d["nodes"][0].update(mesh=-1)),
        "a huge scale": changed(lambda d: d["nodes"][0].update(scale=[1e300] * 3)),
        "compressed": changed(lambda d: d["meshes"][0]["primitives"][0].update(extensions={"KHR_draco_mesh_compression": {"bufferView": 0}})),
        "no scene": changed(lambda d: d.update(scene=3)),
        "a scene of nothing": changed(lambda d: d.update(scenes=[{}])),
        "one view by many accessors": changed(_by_many_accessors, 2**17),
        "one accessor by many primitives": changed(_by_many_primitives, 2**17),
        "one accessor by many meshes": changed(_by_many_meshes, 2**17),
        "no document": lambda: glb_bytes([]),
    }  # fmt: skip


def _of_many_rows(document: dict[str, Any]) -> None:
    document["bufferViews"][0]["byteLength"], document["accessors"][0]["count"] = 2**17, 10_000


def _by_many_accessors(document: dict[str, Any]) -> None:
    _of_many_rows(document)
    document["accessors"] = [document["accessors"][0]] * 500
    document["meshes"][0]["primitives"] = [{"attributes": {"POSITION": number}} for number in range(500)]


def _by_many_primitives(document: dict[str, Any]) -> None:
    document["bufferViews"][1]["byteLength"], document["accessors"][1]["count"] = 2**17, 60_000
    document["meshes"][0]["primitives"] *= 500


def _by_many_meshes(document: dict[str, Any]) -> None:
    _of_many_rows(document)
    document["meshes"] *= 500
    document["nodes"], document["scenes"] = [{"mesh": number} for number in range(500)], [{"nodes": [*range(500)]}]


@pytest.mark.parametrize("name", hostile_glbs())
def test_a_hostile_glb_is_refused_before_its_numbers_take_memory(tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.glb"
    path.write_bytes(hostile_glbs()[name]())
    assert peak_of(path, refused=True) < TIMES * path.stat().st_size + ROOM


def peak_of(path: Path, *, refused: bool = False) -> int:
    """Bytes at the peak of describing a file."""
    tracemalloc.start()
    try:
        with pytest.raises(BadInput) if refused else suppress(BadInput):
            describe_mesh(path)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


PLY = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n{}end_header\n"
LIST, FACE_LIST = "property list uchar uchar p{}\n", "element face {}\nproperty list {} vertex_indices\n"
BLOCK = b"o %\nusemtl %\nv 0 0 %\nv 1 0 %\nv 0 1 %\nf -3 -2 -1\n"


def large(name: str) -> bytes:
    """Files that a reader could take more than their size for."""
    little, points = "binary_little_endian", np.random.default_rng(0).random((3, 3)).astype("<f4").tobytes()
    if name == "instances":
        document, data = box_glb()
        document["nodes"] = [{"mesh": 0, "translation": [k, 0, 0]} for k in range(2000)]
        document["scenes"] = [{"nodes": [*range(2000)]}]
        return glb_bytes(document, data)
    if name == "strip of bytes":
        document, data = box_glb()
        count = 4_000_000
        document["bufferViews"].append({"buffer": 0, "byteOffset": len(data), "byteLength": count})
        document["accessors"][1] = {"bufferView": 2, "componentType": 5121, "count": count, "type": "SCALAR"}
        document["meshes"][0]["primitives"][0]["mode"] = 5
        return glb_bytes(document, data + bytes(count))
    ply = PLY.format(little, 3, "{}").format
    return {
        "blocks.obj": lambda: b"".join(BLOCK.replace(b"%", b"%d" % k) for k in range(5000)),
        "polygon.obj": lambda: b"v 0 0 0\n" * 3 + b"f" + b" 1" * 2_000_000 + b"\n",
        "empty lines.ply": lambda: PLY.format("ascii", 1, "").encode() + b"0 0 0\n" + b"\n" * 1_000_000,
        "empty lines.xyz": lambda: b"0 0 0\n" + b"\n" * 1_000_000,
        "one line.xyz": lambda: b"0 0 0" + b" 1" * 3_000_000,
        "solids.stl": lambda: b"solid a\nfacet\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendfacet\nendsolid a\n" * 5000,
        "one line.stl": lambda: b"solid a\n" + b"vertex" * 1_000_000,
        "many lists.ply": lambda: ply("element face 1\n" + "".join(LIST.format(k) for k in range(2000))).encode() + points + bytes(4000),
        "many elements.ply": lambda: ply("".join(f"element e{k} 0\n{LIST.format(0)}" for k in range(1000))).encode() + points + bytes(3_000_000),
        "corners of a byte.ply": lambda: ply(FACE_LIST.format(1, "uint uchar")).encode() + points + struct.pack("<I", 6_000_000) + bytes(6_000_000),
        "vertices of nothing.ply": lambda: b"ply\nformat binary_little_endian 1.0\nelement vertex 999999999999\nend_header\n",
        "more vertices than bytes.ply": lambda: PLY.format(little, 999_999_999, "").encode() + points,
        "more rows than lines.ply": lambda: PLY.format("ascii", 999_999_999, "").encode() + b"0 0 0\n",
        "empty faces.ply": lambda: ply(FACE_LIST.format(1_000_000, "uchar int")).encode() + points + bytes(1_000_000),
        "a list of many.ply": lambda: ply(FACE_LIST.format(1, "uint int")).encode() + points + b"\xff" * 20,
    }[name]()


LARGE = ("instances", "strip of bytes", "blocks.obj", "polygon.obj", "empty lines.ply", "empty lines.xyz", "one line.xyz", "solids.stl", "one line.stl",
         "many lists.ply", "many elements.ply", "corners of a byte.ply", "vertices of nothing.ply", "more vertices than bytes.ply",
         "more rows than lines.ply", "empty faces.ply", "a list of many.ply")  # fmt: skip


@pytest.mark.parametrize("name", LARGE)
def test_memory_is_bounded_by_the_files_size(tmp_path: Path, name: str) -> None:
    path = tmp_path / f"a{Path(name).suffix or '.glb'}"
    path.write_bytes(large(name))
    assert peak_of(path) < TIMES * path.stat().st_size + ROOM


def test_an_obj_of_many_blocks_takes_time_by_its_size(tmp_path: Path) -> None:
    """20,000 blocks took 43 s, and time by the square of their number."""
    data = b"".join(BLOCK.replace(b"%", b"%d" % k) for k in range(20_000))
    began = time.process_time()
    assert described(tmp_path / "a.obj", data)["faces"] == 20_000
    assert time.process_time() - began < 5.0


def test_no_library_of_meshes_reads_a_file_of_anybody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What trimesh takes for a file is bounded by nothing."""
    for name in ("load", "load_mesh", "load_path", "load_scene"):
        monkeypatch.setattr(trimesh, name, lambda *_, **__: pytest.fail("trimesh reads a file"))
    (tmp_path / "a.obj").write_bytes(b"v 0 0 0\n")
    assert main(["inspect", str(tmp_path / "a.obj")]) == 0
