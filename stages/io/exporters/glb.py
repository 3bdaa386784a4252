"""GLB, the binary form of glTF 2.0, written so that a viewer shows what was captured.

Axes     glTF's y is up. The mesh is turned by the shortest rotation that takes the capture's up direction to +y: from a frame with z up
         (x, y, z) becomes (x, z, -y), one with y up stays, one with y down becomes (x, -y, -z). The matrix is in the node's extras.
Colour   COLOR_0 holds linear light by definition; 16 bits, because 8 linear bits band in the shadows. The material is unlit: the colours
         already hold the light of the capture, and no viewer's lamps shall be added to it.

Khronos, glTF 2.0 specification, sections 3.7.2.1 (attributes) and 4.4 (binary); extension KHR_materials_unlit.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.rendering.colour import linear_from_srgb
from efficientnerf.surface.mesh import Mesh
from stages.io.exporters.writing import CAPTURE_IS_Z_UP, SourceFrame, check_mesh, write_parts

_FLOAT, _USHORT, _UINT = 5126, 5123, 5125
_VERTICES, _INDICES = 34962, 34963  # buffer view targets


def gltf_from_capture(up: np.ndarray) -> np.ndarray:
    """(3, 3) the shortest rotation from a frame with this up direction (unit, (3,)) to one with y up; about x where up is -y."""
    x, y, z = np.round(up, 12)
    if y <= -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    axis = np.array([[0, -x, 0], [x, 0, z], [0, -z, 0]])  # cross product matrix of up x (0, 1, 0)
    return np.eye(3) + axis + axis @ axis / (1 + y)


def write_mesh(mesh: Mesh, path: Path, frame: SourceFrame = CAPTURE_IS_Z_UP) -> None:
    """Write a mesh given in the capture's frame. Raises BadInput."""
    check_mesh(mesh, path)
    rotation = gltf_from_capture(frame.up)
    normals = mesh.normals @ rotation.T
    linear = np.concatenate([linear_from_srgb(np.clip(mesh.colours.astype(np.float64), 0, 1)), np.ones((len(mesh.colours), 1))], 1)
    arrays = [  # each is a multiple of four bytes long, as alignment asks
        np.ascontiguousarray(mesh.vertices @ rotation.T, "<f4"),
        np.ascontiguousarray(normals / np.linalg.norm(normals, axis=1, keepdims=True), "<f4"),
        np.ascontiguousarray(np.round(linear * 65535), "<u2"),
        np.ascontiguousarray(mesh.faces, "<u4").reshape(-1),
    ]
    described = json.dumps(_document(arrays, rotation, frame), separators=(",", ":"), allow_nan=False).encode()
    described += b" " * (-len(described) % 4)
    size = sum(array.nbytes for array in arrays)
    header = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(described) + 8 + size)
    parts = [header, struct.pack("<I4s", len(described), b"JSON"), described, struct.pack("<I4s", size, b"BIN\0")]
    write_parts(path, [*parts, *(array.tobytes() for array in arrays)])


def _document(arrays: list[np.ndarray], rotation: np.ndarray, frame: SourceFrame) -> dict[str, Any]:
    positions, normals, colours, indices = arrays
    offsets = np.cumsum([0, *(array.nbytes for array in arrays)]).tolist()
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    recorded = frame.world_from_capture
    source = {
        "gltf_from_capture": (matrix + 0.0).tolist(),  # rows
        "capture_up": (frame.up + 0.0).tolist(),
        "unit": "metre" if frame.metric else "unknown",
        "world_from_capture": {"scale": recorded.scale, "rotation": recorded.rotation.tolist(), "translation": recorded.translation.tolist()},
    }
    return {
        "asset": {"version": "2.0", "generator": "efficientnerf"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "surface", "mesh": 0, "extras": {"source_frame": source}}],
        "meshes": [{"name": "surface", "primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}, "indices": 3, "material": 0, "mode": 4}]}],
        "materials": [
            {
                "name": "captured light",
                "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 1], "metallicFactor": 0, "roughnessFactor": 1},
                "extensions": {"KHR_materials_unlit": {}},
            }
        ],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": _FLOAT,
                "count": len(positions),
                "type": "VEC3",
                "min": positions.min(0).tolist(),
                "max": positions.max(0).tolist(),
            },
            {"bufferView": 1, "componentType": _FLOAT, "count": len(normals), "type": "VEC3"},
            {"bufferView": 2, "componentType": _USHORT, "normalized": True, "count": len(colours), "type": "VEC4"},
            {"bufferView": 3, "componentType": _UINT, "count": len(indices), "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": target}
            for offset, array, target in zip(offsets, arrays, (_VERTICES, _VERTICES, _VERTICES, _INDICES))
        ],
        "buffers": [{"byteLength": offsets[-1]}],
    }
