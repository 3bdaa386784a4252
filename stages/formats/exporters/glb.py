"""GLB, the binary form of glTF 2.0, written so that a viewer shows what was captured.

Axes     glTF's y is up. The mesh is turned by the shortest rotation that takes the capture's up direction to +y: from a frame with z up
         (x, y, z) becomes (x, z, -y), one with y up stays, one with y down becomes (x, -y, -z). The matrix is in the node's extras.
Texture  inside of the file, PNG or JPEG, sRGB as glTF has it. Vertices are split at the texture's seams alone. v counts from the upper edge in glTF.
Colour   without a texture COLOR_0, which holds linear light by definition; 16 bits, because 8 linear bits band in the shadows.
Light    the material is unlit: the colours already hold the light of the capture, and no viewer's lamps shall be added to it.
Sides    a mesh with open edges is seen from both sides.

Khronos, glTF 2.0 specification, sections 3.7.2.1 (attributes), 3.8 (textures) and 4.4 (binary); extension KHR_materials_unlit.
"""

import json
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.geometry.cameras import Similarity
from efficientnerf.rendering.colour import linear_from_srgb
from efficientnerf.surface.mesh import Mesh
from efficientnerf.surface.texturing.corners import split_at_seams
from stages.formats.exporters.textures import MIME, Picture, open_faces, picture_of
from stages.formats.exporters.writing import CAPTURE_IS_Z_UP, SourceFrame, check_mesh, write_parts

_KINDS = {"<f4": 5126, "<u2": 5123, "<u4": 5125}
VERTICES, _INDICES = 34962, 34963  # buffer view targets
_LINEAR, _MIPMAPPED, _CLAMPED = 9729, 9987, 33071
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


def gltf_from_capture(up: np.ndarray) -> np.ndarray:
    """(3, 3) the shortest rotation from a frame with this up direction (unit, (3,)) to one with y up; about x where up is -y."""
    x, y, z = np.round(up, 12)
    if y <= -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    axis = np.array([[0, -x, 0], [x, 0, z], [0, -z, 0]])  # cross product matrix of up x (0, 1, 0)
    return np.eye(3) + axis + axis @ axis / (1 + y)


@dataclass
class Buffer:
    """The binary part as it grows, and the document's lists about it."""

    parts: list[bytes] = field(default_factory=list)
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)
    size: int = 0

    def view(self, data: bytes, **more: Any) -> int:
        """The number of a new buffer view. Each part is padded to a multiple of four bytes, as alignment asks."""
        self.views.append({"buffer": 0, "byteOffset": self.size, "byteLength": len(data), **more})
        self.parts.append(data + bytes(-len(data) % 4))
        self.size += len(self.parts[-1])
        return len(self.views) - 1

    def accessor(self, array: np.ndarray, target: int, **more: Any) -> int:
        """The number of a new accessor of (N, K) or (N,) values."""
        array = np.ascontiguousarray(array)
        view = self.view(array.tobytes(), target=target)
        kind = _TYPES[1 if array.ndim == 1 else array.shape[1]]
        self.accessors.append({"bufferView": view, "componentType": _KINDS[array.dtype.str], "count": len(array), "type": kind, **more})
        return len(self.accessors) - 1


def write_mesh(mesh: Mesh, path: Path, frame: SourceFrame = CAPTURE_IS_Z_UP, picture: Picture = "png") -> None:
    """Write a mesh given in the capture's frame. Raises BadInput."""
    check_mesh(mesh, path)
    rotation = gltf_from_capture(frame.up)
    buffer = Buffer()
    faces, vertex = mesh.faces, np.arange(len(mesh.vertices))
    if mesh.texture is not None:
        corners = split_at_seams(mesh)
        faces, vertex = corners.faces, corners.vertex
    positions = np.asarray(mesh.vertices @ rotation.T, "<f4")[vertex]
    normals = mesh.normals @ rotation.T
    normals = np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True), "<f4")[vertex]
    attributes = {
        "POSITION": buffer.accessor(positions, VERTICES, min=positions.min(0).tolist(), max=positions.max(0).tolist()),
        "NORMAL": buffer.accessor(normals, VERTICES),
    }
    if mesh.texture is not None:
        attributes["TEXCOORD_0"] = buffer.accessor(np.asarray(corners.coordinates * [1, -1] + [0, 1], "<f4"), VERTICES)
    else:
        linear = np.concatenate([linear_from_srgb(np.clip(mesh.colours.astype(np.float64), 0, 1)), np.ones((len(mesh.colours), 1))], 1)
        attributes["COLOR_0"] = buffer.accessor(np.asarray(np.round(linear * 65535), "<u2"), VERTICES, normalized=True)
    primitive = {"attributes": attributes, "indices": buffer.accessor(np.asarray(faces, "<u4").reshape(-1), _INDICES), "material": 0, "mode": 4}
    colours = picture_of(mesh, picture)
    material: dict[str, Any] = {"name": "captured light", "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 1], "metallicFactor": 0, "roughnessFactor": 1}}
    images = [] if colours is None else [{"bufferView": buffer.view(colours), "mimeType": MIME[picture], "name": "colours"}]
    if images:
        material["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
    material["extensions"] = {"KHR_materials_unlit": {}}
    more = {
        "materials": [material | ({"doubleSided": True} if open_faces(mesh.faces) else {})],
        **({"textures": [{"source": 0, "sampler": 0}], "images": images,
            "samplers": [{"magFilter": _LINEAR, "minFilter": _MIPMAPPED, "wrapS": _CLAMPED, "wrapT": _CLAMPED}]} if images else {}),
    }  # fmt: skip
    write_document("surface", primitive, "KHR_materials_unlit", frame, buffer, path, more)


def write_document(
    name: str, primitive: dict[str, Any], extension: str, frame: SourceFrame, buffer: Buffer, path: Path, more: dict[str, Any] | None = None
) -> None:
    """Write one node with one primitive, whose data are in the buffer. `more`: of the document, as materials."""
    rotation, recorded = Similarity(1.0, gltf_from_capture(frame.up), np.zeros(3)).matrix(), frame.world_from_capture
    source_frame = {
        "gltf_from_capture": (rotation + 0.0).tolist(),  # rows
        "capture_up": (frame.up + 0.0).tolist(),
        "unit": frame.unit,
        "world_from_capture": {"scale": recorded.scale, "rotation": recorded.rotation.tolist(), "translation": recorded.translation.tolist()},
    }
    document = {
        "asset": {"version": "2.0", "generator": "efficientnerf"},
        "extensionsUsed": [extension],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": name, "mesh": 0, "extras": {"source_frame": source_frame}}],
        "meshes": [{"name": name, "primitives": [primitive]}],
        **(more or {}),
        "accessors": buffer.accessors, "bufferViews": buffer.views, "buffers": [{"byteLength": buffer.size}],
    }  # fmt: skip
    described = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    described += b" " * (-len(described) % 4)
    header = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(described) + 8 + buffer.size)
    write_parts(path, [header, struct.pack("<I4s", len(described), b"JSON"), described, struct.pack("<I4s", buffer.size, b"BIN\0"), *buffer.parts])
