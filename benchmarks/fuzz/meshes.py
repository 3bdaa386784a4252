"""Readers of mesh files that `inspect` describes, and of the pages of a run."""

import contextlib
import hashlib
import json
import re
import struct
from collections.abc import Callable
from pathlib import Path
from random import Random

from benchmarks.fuzz import json_text, lines
from benchmarks.fuzz.binary import changed_bytes
from benchmarks.fuzz.reader import Opened, Reader, bytes_of
from benchmarks.fuzz.runs import run_in

PAGE = "report.html"
POLYGONS = b"""ply
format ascii 1.0
comment of a scanner
element vertex 5
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
element face 3
property list uchar int vertex_indices
property float area
end_header
0 0 0 1 2 3
1 0 0 1 2 3
1 1 0 1 2 3
0 1 0 1 2 3
0.5 0.5 1 1 2 3
4 0 1 2 3 0.5
3 0 1 4 0.5
5 0 1 2 3 4 0.5
"""
SOLID = b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid a\n"
BLOCKS = b"mtllib a.mtl\no a\nusemtl a\nv 0 0 0 1 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvn 0 0 1\nf 1/1/1 2//1 3\ng b\nusemtl b\nf -4 -3 -2 -1\n"


def seeds(suffix: str) -> Callable[[], list[bytes]]:
    """A mesh, or points, as the exporter writes it, and files as others do."""

    def made() -> list[bytes]:
        from efficientnerf.surface.mesh import PointCloud
        from stages.formats.exporters import MESH_EXPORTERS, POINT_EXPORTERS
        from tests.stages.io.meshes import Y_DOWN, block

        mesh, found, name = block(), [], f"a{suffix}"
        if suffix in MESH_EXPORTERS:
            found.append(bytes_of(lambda path: MESH_EXPORTERS[suffix](mesh, path, Y_DOWN), name))
        if suffix in POINT_EXPORTERS:
            found.append(bytes_of(lambda path: POINT_EXPORTERS[suffix](PointCloud(mesh.vertices, mesh.normals, mesh.colours), path, Y_DOWN), name))
        others = {".ply": [POLYGONS], ".stl": [SOLID], ".obj": [BLOCKS], ".glb": [placed(found[0])] if suffix == ".glb" else []}
        return [*found, *others.get(suffix, [])]

    return made


def parts(data: bytes) -> tuple[dict[str, object], bytes] | None:
    """The document of a GLB, and what follows it."""
    length = int.from_bytes(data[12:16], "little")
    document = json_text.parsed(data[20 : 20 + length]) if length < 2**24 else None
    return (document, data[20 + length :]) if isinstance(document, dict) else None


def joined(text: bytes, rest: bytes) -> bytes:
    text += b" " * (-len(text) % 4)
    return b"glTF" + struct.pack("<III", 2, 20 + len(text) + len(rest), len(text)) + b"JSON" + text + rest


def placed(data: bytes) -> bytes:
    """A GLB with its mesh in three places, under nodes of each kind."""
    found = parts(data)
    assert found is not None, "an exporter wrote no GLB"
    document, rest = found
    matrix = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 0, 0, 1]
    nodes = [{"children": [1, 2, 3]}, {"mesh": 0, "translation": [0, 0, 9], "rotation": [0, 0, 0, 1], "scale": [2, 1, 1]}]
    nodes += [{"mesh": 0, "matrix": matrix}, {"mesh": 0}]
    return joined(json.dumps({**document, "nodes": nodes, "scene": 0, "scenes": [{"nodes": [0]}]}).encode(), rest)


def glb_changed(rng: Random, data: bytes) -> bytes:
    """Its document, what follows it, or any bytes; lengths are put right for the first."""
    found = parts(data)
    if found is None or rng.random() < 0.2:
        return changed_bytes(rng, data)
    document, rest = found
    if rng.random() < 0.2:
        return changed_bytes(rng, data, begin=len(data) - len(rest))
    with contextlib.suppress(ValueError, RecursionError):
        for _ in range(1 + rng.randrange(3)):
            document = json_text.with_change(rng, document)
        return joined(json_text.written(document), rest)
    return data


def ply_changed(rng: Random, data: bytes) -> bytes:
    """Its header, line by line, or what follows it."""
    end = data.find(b"end_header\n") + len(b"end_header\n")
    if end < 20 or rng.random() < 0.5:
        return changed_bytes(rng, data, begin=max(end, 0) if rng.random() < 0.7 else 0)
    return lines.changed(rng, data[:end]) + data[end:]


def stl_changed(rng: Random, data: bytes) -> bytes:
    if data.startswith(b"solid a\n"):
        return lines.changed(rng, data)
    found = changed_bytes(rng, data)
    count = (len(found) - 84) // 50
    return found if count < 0 or rng.random() < 0.4 else found[:80] + count.to_bytes(4, "little") + found[84 : 84 + 50 * count]


def open_described(suffix: str) -> Callable[[Path], Opened]:
    """A file that `inspect` describes."""

    def opened(folder: Path) -> Opened:
        from workflows.inspection.describe import describe

        path = folder / f"a{suffix}"

        def read(data: bytes) -> None:
            path.write_bytes(data)
            found = describe(path)
            json.dumps(found, allow_nan=False)
            assert 0 < found.get("vertices", 1) <= len(data), "more vertices than bytes"

        return Opened(read, (("inspect", str(path)), ("inspect", str(path), "--json")))

    return opened


def page_seeds() -> list[bytes]:
    from workflows.report.signature import write_page

    return [bytes_of(lambda path: write_page(path, b"<!doctype html>\n<title>a run</title>\n<p>24 dB</p>\n"), PAGE)]


def page_changed(rng: Random, data: bytes) -> bytes:
    """Any bytes; or what is before the signature, with the digest put right, as whoever has no key can."""
    if rng.random() < 0.4:
        return changed_bytes(rng, data)
    at = data.rfind(b"<!-- enerf ")
    page = changed_bytes(rng, data[: max(at, 0)] + rng.choice((b"", b"<script>alert(1)</script>\n")))
    return page + re.sub(rb"[0-9a-f]{64}", hashlib.sha256(page).hexdigest().encode(), data[max(at, 0) :], count=1)


def open_page(folder: Path) -> Opened:
    """A page in a run: one that was changed is never our own, and it is our own again once a command has shown it."""
    from pipeline.errors import CorruptArtifact
    from workflows.report.signature import is_as_written, is_own

    run = run_in(folder)
    path, own = run / PAGE, page_seeds()

    def read(data: bytes) -> None:
        path.write_bytes(data)
        assert is_own(path) == (data in own), "a page that another wrote"
        if not is_as_written(path):
            raise CorruptArtifact(f"{path}: altered", (PAGE,))

    return Opened(read, (("verify", str(run)), ("report", str(run)), ("status", str(run))))


READERS = (
    Reader("glb", "GLB of meshes", seeds(".glb"), glb_changed, open_described(".glb")),
    Reader("ply", "PLY of meshes and points", seeds(".ply"), ply_changed, open_described(".ply")),
    Reader("obj", "OBJ", seeds(".obj"), lines.changed, open_described(".obj"), share=0.5),
    Reader("stl", "STL", seeds(".stl"), stl_changed, open_described(".stl"), share=0.25),
    Reader("xyz", "XYZ", seeds(".xyz"), lines.changed, open_described(".xyz"), share=0.25),
    Reader("page", "pages of a run", page_seeds, page_changed, open_page, share=0.25),
)
