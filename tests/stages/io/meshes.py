"""A block, frames and readers for tests of mesh files."""

import importlib.util
import json
import struct
from pathlib import Path

import numpy as np
import pytest

from efficientnerf.geometry.cameras import Similarity
from efficientnerf.surface.mesh import Mesh, vertex_normals
from stages.formats.exporters.writing import SourceFrame

Z_UP = SourceFrame(Similarity.identity())
Y_DOWN = SourceFrame(Similarity(0.5, np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.array([1.0, 2, 3])), metric=True)
NEEDS_USD = pytest.mark.skipif(importlib.util.find_spec("pxr") is None, reason="usd-core is not installed: pip install 'efficientnerf[usd]'")

NEEDS_LAS = pytest.mark.skipif(importlib.util.find_spec("lazrs") is None, reason="laspy and lazrs are not installed: pip install 'efficientnerf[las]'")


def block() -> Mesh:
    """A box of 1 x 2 x 3 with its corner at (1, 1, 1), its colours from black to white."""
    corners = np.array([[x, y, z] for x in (0.0, 1) for y in (0.0, 1) for z in (0.0, 1)])
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([part for a, b, c, d in sides for part in ((a, b, c), (a, c, d))])
    vertices = corners * [1, 2, 3] + 1
    colours = np.array([[0, 0, 0], [1, 1, 1], [0.5, 0.25, 0.75], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.02, 0.03, 0.04], [0.9, 0.5, 0.1]], np.float32)
    return Mesh(vertices, faces, vertex_normals(vertices, faces), colours)


def glb_document(path: Path) -> tuple[dict, bytes]:
    """The document and the binary part of a file."""
    return glb_parts(path.read_bytes())


def glb_parts(data: bytes) -> tuple[dict, bytes]:
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert size % 4 == 0
    document = json.loads(data[20 : 20 + size])
    binary, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0"
    assert binary == document["buffers"][0]["byteLength"] == len(data) - 28 - size
    return document, data[28 + size :]


def glb_bytes(document: object, data: bytes = b"") -> bytes:
    """A GLB of a document and its binary part, which may be none."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    data += bytes(-len(data) % 4)
    parts = struct.pack("<I4s", len(text), b"JSON") + text + (struct.pack("<I4s", len(data), b"BIN\0") + data if data else b"")
    return struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts


def accessor(document: dict, blob: bytes, index: int) -> np.ndarray:
    entry = document["accessors"][index]
    view = document["bufferViews"][entry["bufferView"]]
    width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[entry["type"]]
    kind = {5126: "<f4", 5121: "u1", 5123: "<u2", 5125: "<u4"}[entry["componentType"]]
    assert view["byteOffset"] % 4 == 0
    assert entry["count"] * width * np.dtype(kind).itemsize == view["byteLength"]
    return np.frombuffer(blob, kind, entry["count"] * width, view["byteOffset"]).reshape(-1, width)
