"""PLY, binary or text: the places, colours and faces that it holds."""

import os
import re
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np

from pipeline.text import printable
from stages.io.meshes.geometry import AT_ONCE, Damaged, Geometry, exactly, lines_of, triangles_of

MAX_HEADER = 2**16  # bytes
MAX_PROPERTIES = 256  # of an element; Gaussians have up to 62, with normals 65
MAX_ELEMENTS = 16  # scanners write vertices, faces, edges, materials and a camera
MOST_OF_SHORT = 2**22  # corners whose numbers have one or two bytes: 65,536 vertices have six each
TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4",
    "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_FACES = ("vertex_indices", "vertex_index")
_COLOURS = ("red", "green", "blue")


@dataclass(frozen=True)
class Property:
    """counts: the type of a list's length, of a list alone"""

    name: str
    type: np.dtype[np.generic]
    counts: np.dtype[np.generic] | None = None


@dataclass(frozen=True)
class Element:
    name: str
    count: int
    properties: list[Property]

    @property
    def place(self) -> int:
        """Of the list of a face's vertices among the properties; -1: none."""
        return next((place for place, each in enumerate(self.properties) if each.counts is not None and each.name in _FACES), -1)


def read_ply(file: BinaryIO, size: int) -> Geometry:
    """The vertices, with their colours, and the faces of a PLY. Raises Damaged and ValueError."""
    kind, _, elements = read_header(file)
    vertices, colours, triangles = np.empty((0, 3)), None, np.empty((0, 3), np.int64)
    for element in elements:
        if any(each.counts is not None for each in element.properties):
            corners, sizes = (_text_lists if kind == "ascii" else _lists)(file, element)
            if corners.itemsize < 4 and len(corners) > MOST_OF_SHORT:
                raise Damaged(f"{len(corners)} corners of faces, of at most 65,536 vertices")
            triangles = triangles_of(corners, sizes) if element.name == "face" else triangles
            continue
        wanted = [[each.name for each in element.properties].index(name) for name in _columns(element)]
        rows = (_text_rows if kind == "ascii" else _rows)(file, element, wanted)
        if element.name == "vertex" and len(wanted) >= 3:
            vertices, colours = rows[:, :3], _bytes(rows[:, 3:], element.properties[wanted[-1]].type)
    return Geometry(vertices, triangles, colours)


def read_header(file: BinaryIO) -> tuple[str, list[str], list[Element]]:
    """The kind of a PLY ("ascii"), its comments, and its elements; the file is left where their rows begin. Raises Damaged."""
    head = file.read(MAX_HEADER)
    end = re.search(rb"\nend_header\r?\n", head)
    if not head.startswith(b"ply") or end is None:
        raise Damaged("no PLY, or one of a header beyond 64 KiB")
    lines = head[: end.start()].decode("ascii", "replace").splitlines()
    words = [line.split() for line in lines]
    kind = next((line[1] for line in words if line[:1] == ["format"] and len(line) > 1), "")
    order = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}.get(kind)
    if order is None:
        raise Damaged("its header has no format that is known")
    file.seek(end.end())
    return kind, [line.strip()[8:] for line in lines if line.startswith("comment ")], _elements(words, order)


def _columns(element: Element) -> list[str]:
    """The properties of a vertex that are read: its place, and its colours where it has them; of others none."""
    names = {each.name for each in element.properties}
    if element.name != "vertex" or not names.issuperset("xyz"):
        return []
    return [*"xyz", *(_COLOURS if names.issuperset(_COLOURS) else ())]


def _elements(lines: list[list[str]], order: str) -> list[Element]:
    found: list[Element] = []
    for words in lines:
        if words[:1] == ["element"]:
            if len(words) != 3 or not re.fullmatch(r"[0-9]{1,12}", words[2]):
                raise Damaged("its header has an element without a number")
            found.append(Element(words[1], int(words[2]), []))
            if len(found) > MAX_ELEMENTS:
                raise Damaged(f"more than {MAX_ELEMENTS} elements")
        elif words[:1] == ["property"]:
            kinds = words[2:4] if words[1:2] == ["list"] else words[1:2]
            if not found or len(words) != (5 if words[1:2] == ["list"] else 3) or not all(each in TYPES for each in kinds):
                raise Damaged(f"its header has the line '{printable(' '.join(words), 80)}'; expected a property of a known type")
            types = [np.dtype(order + TYPES[each]) for each in kinds]
            if len(types) == 2 and types[0].kind not in "iu":
                raise Damaged("its header has a list of a length that is no whole number")
            found[-1].properties.append(Property(words[-1], types[-1], types[0] if len(types) == 2 else None))
            if len(found[-1].properties) > MAX_PROPERTIES:
                raise Damaged(f"an element of more than {MAX_PROPERTIES} properties")
    return found


def _rows(file: BinaryIO, element: Element, wanted: list[int]) -> np.ndarray:
    """(count, len(wanted)) of an element without lists."""
    row = np.dtype([(str(place), each.type) for place, each in enumerate(element.properties)])
    left = os.fstat(file.fileno()).st_size - file.tell()
    if element.count * row.itemsize > left:
        raise Damaged(f"it is cut short: {element.count} rows of '{printable(element.name, 40)}' in {left} bytes")
    if not wanted:
        file.seek(element.count * row.itemsize, 1)
        return np.empty((0, 0))
    found = np.empty((element.count, len(wanted)))
    for done in range(0, element.count, AT_ONCE):
        part = np.frombuffer(exactly(file, row.itemsize * min(AT_ONCE, element.count - done)), row)
        for column, place in enumerate(wanted):
            found[done : done + len(part), column] = part[str(place)]
    return found


def _lists(file: BinaryIO, element: Element) -> tuple[np.ndarray, np.ndarray]:
    """The corners of all faces of an element with lists, and how many each has."""
    place, start = element.place, file.tell()
    data = file.read()
    row, lengths = _first_row(data, element)
    if row is not None and element.count * row.itemsize <= len(data):
        rows = np.frombuffer(data, row, element.count)
        if all((rows[f"n{number}"] == length).all() for number, length in lengths.items()):
            file.seek(start + element.count * row.itemsize)
            if lengths.get(place, 0) < 3:
                return np.empty(0, np.int64), np.empty(0, np.int64)
            return rows[str(place)].reshape(-1), np.full(element.count, lengths[place])
    at, corners, sizes = 0, bytearray(), array("q")
    kinds = [(each.type.itemsize, each.counts) for each in element.properties]
    reads: list[Callable[[int], int] | None] = [None if counts is None else _length_at(data, counts) for _, counts in kinds]
    for _ in range(element.count):
        for number, (width, counts) in enumerate(kinds):
            read = reads[number]
            if read is None or counts is None:
                at += width
                continue
            length = read(at)
            at += counts.itemsize
            if number == place and length > 2:
                corners += data[at : at + length * width]
                sizes.append(length)
            at += length * width
        if at > len(data):
            raise Damaged("it is cut short")
    file.seek(start + at)
    return np.frombuffer(bytes(corners), element.properties[place].type), np.array(sizes, np.int64)


def _length_at(data: bytes, counts: np.dtype[np.generic]) -> Callable[[int], int]:
    """Reads the length of a list at a place of the data."""
    width, order, signed = counts.itemsize, "big" if counts.str[0] == ">" else "little", counts.kind == "i"

    def read(at: int) -> int:
        length = int.from_bytes(data[at : at + width], order, signed=signed)  # type: ignore[arg-type]
        if length < 0:
            raise Damaged("a list of fewer than no numbers")
        return length

    return read


def _first_row(data: bytes, element: Element) -> tuple[np.dtype[np.void] | None, dict[int, int]]:
    """The type of all rows where they are as the first one is, and the lengths of its lists by their places; None where there is no first one."""
    fields: list[tuple[str, np.dtype[np.generic]] | tuple[str, np.dtype[np.generic], tuple[int]]] = []
    at, lengths = 0, {}
    for number, each in enumerate(element.properties):
        if each.counts is None:
            fields.append((str(number), each.type))
            at += each.type.itemsize
            continue
        length = _length_at(data, each.counts)(at)
        lengths[number] = length
        at += each.counts.itemsize + length * each.type.itemsize
        if at > len(data):
            return None, {}
        fields += [(f"n{number}", each.counts), (str(number), each.type, (length,))]
    return np.dtype(fields), lengths


def _text_rows(file: BinaryIO, element: Element, wanted: list[int]) -> np.ndarray:
    """As `_rows`, of text."""
    numbers, lines = array("d"), lines_of(file)
    for _ in range(element.count):
        words = _next(lines)
        if len(words) < len(element.properties):
            raise Damaged("a row of fewer numbers than its header names")
        numbers.extend(float(words[place]) for place in wanted)
    return np.array(numbers).reshape(-1, max(len(wanted), 1))


def _text_lists(file: BinaryIO, element: Element) -> tuple[np.ndarray, np.ndarray]:
    """As `_lists`, of text."""
    corners, sizes, lines, place = array("q"), array("q"), lines_of(file), element.place
    for _ in range(element.count):
        words, at = _next(lines), 0
        for number, each in enumerate(element.properties):
            if at >= len(words):
                raise Damaged("a row of fewer numbers than its header names")
            length = 1 if each.counts is None else int(words[at])
            at += each.counts is not None
            if not 0 <= length <= len(words) - at:
                raise Damaged("a list of more numbers than its row has")
            if number == place and length > 2:
                corners.extend(map(int, words[at : at + length]))
                sizes.append(length)
            at += length
    return np.array(corners), np.array(sizes)


def _next(lines: Iterator[list[bytes]]) -> list[bytes]:
    words = next(lines, None)
    if words is None:
        raise Damaged("it is cut short")
    return words


def _bytes(colours: np.ndarray, kind: np.dtype[Any]) -> np.ndarray | None:
    """Colours as bytes: from 0 to 1 where they are floating-point numbers."""
    if not colours.shape[1]:
        return None
    scale = 255 if kind.kind == "f" else 255 / np.iinfo(kind).max if kind.itemsize > 1 else 1
    with np.errstate(invalid="ignore", over="ignore"):
        return np.nan_to_num(np.clip(np.round(colours * scale), 0, 255)).astype(np.uint8)
