"""GLB: its document and its accessors, checked against the file's size before a number of them is read.

glTF 2.0, sections 3.6 (buffers and accessors), 3.5 (nodes), 4.4 (GLB).
"""

import struct
from collections.abc import Iterator
from typing import Any, BinaryIO

import numpy as np

from pipeline.files import MAX_JSON, json_value
from pipeline.text import printable
from stages.io.meshes.geometry import AT_ONCE, Damaged, Geometry, exactly

MAX_STRIDE = 252  # bytes; glTF 2.0, bufferView.byteStride
MOST_TIMES = 8  # the file's size may be read: primitives may share what they refer to
FACES, FACE = 2**16, 4  # triangles that there may be anyhow; bytes of the file for each more: with their vertices they take eight and more
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_UNSUPPORTED_LAYOUT = "accessors that do not lie in the file's own binary part, row by row (write it without compression)"
_LARGEST = 1e15  # of a number in a node


class Glb:
    """A file that is read by its accessors. Raises Damaged, and Unreadable for a document that is none."""

    def __init__(self, file: BinaryIO, size: int, limit: int = MAX_JSON) -> None:
        self.file = file
        head = file.read(20)
        if len(head) < 20 or head[:4] != b"glTF" or head[4:8] != b"\2\0\0\0" or head[16:] != b"JSON":
            raise Damaged("no GLB of version 2")
        length, described = struct.unpack_from("<II", head, 8)
        if length > size or described > min(size, limit):
            raise Damaged(f"{size} bytes; expected {length}, of which a document of at most {limit}")
        self.document = json_value(exactly(file, described))  # its JSON
        chunk = file.read(8)
        self.start = self.end = 28 + described
        if len(chunk) == 8 and chunk[4:] == b"BIN\0":
            self.end += int.from_bytes(chunk[:4], "little")
        if self.end > max(size, self.start):
            raise Damaged("its binary part is cut short")
        self._left, self._faces_left = MOST_TIMES * size, FACES + size // FACE

    def rows(self, number: int, widths: str) -> Iterator[np.ndarray]:
        """The rows of an accessor of this type ("VEC3"), in pieces: floats, or whole numbers as they are stored. Raises Damaged where it does not lie in the
        binary part, and where all that was read comes to many times the file."""
        entry = self.document["accessors"][_place(number)]
        if "bufferView" not in entry or "sparse" in entry:
            raise Damaged(_UNSUPPORTED_LAYOUT)
        view = self.document["bufferViews"][_place(entry["bufferView"])]
        kind = _TYPES.get(entry["componentType"])
        numbers = [entry["count"], view.get("byteOffset", 0), entry.get("byteOffset", 0), view["byteLength"], view.get("byteStride", 0)]
        if not all(type(each) is int and 0 <= each < 2**53 for each in numbers) or view.get("buffer", 0) != 0 or "uri" in self.document["buffers"][0]:
            raise Damaged(_UNSUPPORTED_LAYOUT)
        count, width = numbers[0], _WIDTHS[widths]
        if kind is None or entry["type"] != widths or count < 1:
            raise Damaged(f"an accessor of {count} {printable(entry['type'], 20)}; expected {widths}")
        row = width * np.dtype(kind).itemsize
        stride, first = numbers[4] or row, self.start + numbers[1] + numbers[2]
        if not row <= stride <= max(row, MAX_STRIDE):
            raise Damaged(f"rows that lie {stride} bytes apart; expected {row} to {MAX_STRIDE}")
        if first + stride * (count - 1) + row > min(self.end, self.start + numbers[1] + numbers[3]):
            raise Damaged("an accessor that goes on beyond the binary part")
        self._left -= stride * count
        if self._left < 0:
            raise Damaged(f"primitives that refer to the same rows again and again: more than {MOST_TIMES} times the file")
        for done in range(0, count, AT_ONCE):
            some = min(AT_ONCE, count - done)
            self.file.seek(first + done * stride)
            raw = exactly(self.file, stride * (some - 1) + row)
            yield np.ndarray((some, width), kind, raw, strides=(stride, np.dtype(kind).itemsize))

    def meshes(self) -> dict[int, list[np.ndarray]]:
        """The meshes of the scene by their numbers, each with where it is placed: matrices (4, 4). No node has two parents, so none counts twice."""
        nodes = self.document.get("nodes", [])
        roots = self.document["scenes"][_place(self.document.get("scene", 0))].get("nodes", [])
        found: dict[int, list[np.ndarray]] = {}
        seen: set[int] = set()
        pending = [(_place(root), np.eye(4)) for root in roots]
        while pending:
            number, above = pending.pop()
            if number in seen:
                raise Damaged("a node with two parents")
            seen.add(number)
            with np.errstate(all="ignore"):
                world = above @ _matrix(nodes[number])
            if "mesh" in nodes[number]:
                found.setdefault(_place(nodes[number]["mesh"]), []).append(world)
            pending += [(_place(child), world) for child in nodes[number].get("children", [])]
        return found

    def geometry(self, mesh: int) -> Geometry:
        """The shape of a mesh, all its primitives together, in its own frame; vertices that primitives share count once."""
        vertices: list[np.ndarray] = []
        triangles = [np.empty((0, 3), np.int64)]
        begins: dict[int, tuple[int, int]] = {}  # accessor -> the first of its vertices, and their number
        total = 0
        for primitive in self.document["meshes"][mesh]["primitives"]:
            if below := [name for name in primitive.get("extensions", {}) if "compression" in name]:
                raise Damaged(f"compressed by {printable(below[0], 80)}; expected attributes as they are (write it without compression)")
            accessor = _place(primitive["attributes"]["POSITION"])
            if accessor not in begins:
                rows = np.concatenate(list(self.rows(accessor, "VEC3"))).astype(np.float64)
                stored = self.document["accessors"][accessor]
                if stored.get("normalized") is True and stored["componentType"] != 5126:
                    rows /= np.iinfo(_TYPES[stored["componentType"]]).max
                begins[accessor] = total, len(rows)
                vertices.append(rows)
                total += len(rows)
            begin, count = begins[accessor]
            order = np.arange(count)
            if "indices" in primitive:
                order = np.concatenate(list(self.rows(primitive["indices"], "SCALAR"))).reshape(-1)
            if order.dtype.kind not in "iu" or (len(order) and int(order.max()) >= count):
                raise Damaged(f"faces of vertices that are none of {count}")
            self._faces_left -= len(order) // (3 if (mode := primitive.get("mode", _TRIANGLES)) == _TRIANGLES else 1)
            if self._faces_left < 0:
                raise Damaged("more faces than its bytes hold")
            # (F, 3) of the vertices in their order; none of points and lines
            if mode == _TRIANGLES:
                found = order[: len(order) // 3 * 3].reshape(-1, 3)
            elif mode in (_STRIP, _FAN) and len(order) >= 3:
                found = np.stack([order[:-2] if mode == _STRIP else np.full(len(order) - 2, order[0]), order[1:-1], order[2:]], axis=1)
            else:
                found = order[:0].reshape(0, 3)
            triangles.append(begin + found.astype(np.int64))
        return Geometry(np.concatenate([np.empty((0, 3)), *vertices]), np.concatenate(triangles))


def _matrix(node: Any) -> np.ndarray:
    """Of a node: into its parent's frame."""
    if "matrix" in node:
        return _numbers(node["matrix"], 16).reshape(4, 4).T
    x, y, z, w = _numbers(node.get("rotation", [0, 0, 0, 1]), 4)
    turned = np.array(
        [[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
         [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
         [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]]
    )  # fmt: skip
    found = np.eye(4)
    found[:3, :3] = turned * _numbers(node.get("scale", [1, 1, 1]), 3)
    found[:3, 3] = _numbers(node.get("translation", [0, 0, 0]), 3)
    return found


def _numbers(value: Any, count: int) -> np.ndarray:
    if not isinstance(value, list) or len(value) != count or not all(type(each) in (int, float) and abs(each) <= _LARGEST for each in value):
        raise Damaged(f"a node whose place is not {count} numbers")
    return np.array(value, np.float64)


def _place(value: Any) -> int:
    """A place in a list of the document: whole, and not counted from the end."""
    if type(value) is not int or value < 0:
        raise Damaged(f"{printable(value, 40)} where a number of an entry is expected")
    return value
