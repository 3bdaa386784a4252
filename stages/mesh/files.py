"""The mesh that the stage `mesh` has written, read again: the file of shared vertices, where the GLB has them in the texture, and that. And files of a mesh
without faces, which exporters refuse."""

import json
import struct
from math import prod
from pathlib import Path
from typing import NoReturn

import numpy as np

from efficientnerf.surface.mesh import Mesh, Texture
from pipeline.errors import CorruptArtifact
from stages.artifacts import MeshOutputs
from stages.formats.exporters.obj import head as obj_head
from stages.formats.exporters.ply import FACE, VERTEX
from stages.formats.exporters.ply import mesh_header as ply_header
from stages.formats.exporters.writing import MOST_TEXELS, SourceFrame, write_parts
from stages.io.meshes.glb import Glb
from stages.io.pictures import UnreadableImage, read_header
from stages.io.png import read_png

MOST_BYTES = 2**32  # of a file that is read


def read_mesh(outputs: MeshOutputs) -> Mesh:
    """The mesh in the capture's frame, as the files hold it: single precision, colours of 8 bits. Raises CorruptArtifact where they are not as the stage
    writes them."""
    vertices, faces = _read_ply(outputs.ply)
    positions = np.stack([vertices[name] for name in ("x", "y", "z")], 1).astype(np.float64)
    normals = np.stack([vertices[name] for name in ("nx", "ny", "nz")], 1).astype(np.float64)
    colours = np.stack([vertices[name] for name in ("red", "green", "blue")], 1) / np.float32(255)
    return Mesh(positions, faces, normals, colours, texture=_read_texture(outputs, faces, positions) if len(faces) else None)


def read_vertices(outputs: MeshOutputs) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) in the capture's frame, and their normals. Raises CorruptArtifact."""
    vertices, _ = _read_ply(outputs.ply)
    places, normals = (np.stack([vertices[name] for name in names], 1).astype(np.float64) for names in (("x", "y", "z"), ("nx", "ny", "nz")))
    return places, normals


def mesh_bytes(outputs: MeshOutputs) -> int:
    """Bytes of memory that a mesh takes while it is read and used: its arrays, and those of its texture."""
    texels = prod(read_header(outputs.texture).size) if outputs.texture.is_file() else 0
    return 16 * (_size(outputs.ply) + _size(outputs.glb) // 4) + 12 * texels


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0


def write_empty_meshes(outputs: MeshOutputs, frame: SourceFrame) -> None:
    """PLY, GLB and OBJ without vertices and faces; the GLB, in which no mesh may be empty, without a mesh."""
    write_parts(outputs.ply, [ply_header(0, 0, frame).encode("ascii")])
    document = {"asset": {"version": "2.0", "generator": "efficientnerf"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"name": "surface"}]}
    described = json.dumps(document, separators=(",", ":")).encode()
    described += b" " * (-len(described) % 4)
    write_parts(outputs.glb, [struct.pack("<4sII", b"glTF", 2, 20 + len(described)), struct.pack("<I4s", len(described), b"JSON"), described])
    write_parts(outputs.obj, [obj_head(frame)])


def _refuse(path: Path, why: str) -> NoReturn:
    raise CorruptArtifact(f"{path}: {why}. Make the mesh again.", (str(path),))


def _data(path: Path) -> bytes:
    try:
        if path.stat().st_size > MOST_BYTES:
            _refuse(path, f"larger than {MOST_BYTES} bytes")
        return path.read_bytes()
    except OSError as error:
        _refuse(path, error.strerror or str(error))


def _read_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Rows of VERTEX, and faces (F, 3) int64."""
    head, found, body = _data(path).partition(b"end_header\n")
    counts = {}
    for line in head.decode("ascii", "replace").splitlines() if found else ():
        words = line.split()
        if len(words) == 3 and words[0] == "element" and words[2].isdigit():
            counts[words[1]] = int(words[2])
    if counts.keys() != {"vertex", "face"} or len(body) != counts["vertex"] * VERTEX.itemsize + counts["face"] * FACE.itemsize:
        _refuse(path, "not as it was written")
    vertices = np.frombuffer(body, VERTEX, counts["vertex"])
    faces = np.frombuffer(body, FACE, counts["face"], vertices.nbytes)["vertex_indices"].astype(np.int64)
    if (len(vertices) and not len(faces)) or (len(faces) and (faces.min() < 0 or faces.max() >= len(vertices))):
        _refuse(path, "its faces name vertices that it does not have")
    return vertices, faces


def _read_texture(outputs: MeshOutputs, faces: np.ndarray, positions: np.ndarray) -> Texture | None:
    """The texture of a mesh of these faces, in the order of the GLB; None where it has none."""
    path = outputs.glb
    try:
        with open(path, "rb") as file:
            glb = Glb(file, path.stat().st_size)
            (primitive,) = glb.document["meshes"][0]["primitives"]
            attributes = primitive["attributes"]
            if "TEXCOORD_0" not in attributes:
                return None
            accessors = ((primitive["indices"], "SCALAR"), (attributes["TEXCOORD_0"], "VEC2"), (attributes["POSITION"], "VEC3"))
            corners, coordinates, places = (np.concatenate([*glb.rows(number, kind)]) for number, kind in accessors)
        corners, coordinates = corners.reshape(-1, 3).astype(np.int64), coordinates.astype(np.float64) * [1, -1] + [0, 1]
        turn = np.array(glb.document["nodes"][0]["extras"]["source_frame"]["gltf_from_capture"], np.float64)[:3, :3]
        same = corners.shape == faces.shape and np.allclose(places[corners] @ turn, positions[faces], rtol=1e-5, atol=1e-5 * float(np.abs(positions).max()))
        at = np.clip(coordinates[corners], 0, 1)
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, OSError) as error:
        _refuse(path, f"not as it was written ({type(error).__name__})")
    if not same:
        _refuse(path, "its faces are not those of the PLY next to it")
    return Texture(at, _picture(outputs.texture))


def _picture(path: Path) -> np.ndarray:
    try:
        if max(read_header(path).size) > MOST_TEXELS:
            _refuse(path, f"more than {MOST_TEXELS} texels along a side")
        picture = read_png(path)
    except UnreadableImage as error:
        _refuse(path, str(error))
    if picture.ndim != 3 or picture.shape[2] != 3:
        _refuse(path, "not as it was written")
    return picture
