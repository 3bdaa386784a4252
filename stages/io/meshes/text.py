"""OBJ, STL and XYZ, line by line."""

from array import array
from typing import BinaryIO

import numpy as np

from stages.io.meshes.geometry import Damaged, Geometry, exactly, lines_of, triangles_of, vertices_of

_STL_HEADER = 84  # bytes; the last four count the triangles
_STL = np.dtype([("normal", "<f4", 3), ("vertices", "<f4", (3, 3)), ("attributes", "<u2")])


def read_obj(file: BinaryIO, size: int) -> Geometry:
    """Vertices and faces of a Wavefront OBJ; of what else it names nothing is opened. Raises Damaged and ValueError."""
    vertices, corners, sizes = array("d"), array("q"), array("q")
    for words in lines_of(file):
        if words[0] == b"v":
            vertices.extend(_place(words[1:4]))
        elif words[0] == b"f":
            count = len(vertices) // 3
            numbers = [int(word.partition(b"/")[0]) for word in words[1:]]
            corners.extend(number - 1 if number > 0 else count + number if number else -1 for number in numbers)
            sizes.append(len(numbers))
    return Geometry(vertices_of(vertices), triangles_of(np.array(corners), np.array(sizes)))


def read_stl(file: BinaryIO, size: int) -> Geometry:
    """Triangles of an STL, binary where its size is that of as many triangles as it counts, else as text. Raises Damaged and ValueError."""
    head = file.read(_STL_HEADER)
    if len(head) == _STL_HEADER and size == _STL_HEADER + _STL.itemsize * int.from_bytes(head[-4:], "little"):
        vertices = np.frombuffer(exactly(file, size - _STL_HEADER), _STL)["vertices"].reshape(-1, 3).astype(np.float64)
    elif head.lstrip().startswith(b"solid"):
        file.seek(0)
        numbers = array("d")
        for words in lines_of(file):
            if words[0].lower() == b"vertex":
                numbers.extend(_place(words[1:4]))
        vertices = vertices_of(numbers)
    else:
        raise Damaged(f"{size} bytes; expected as many as its triangles take, or text that begins with 'solid'")
    if len(vertices) % 3:
        raise Damaged("its last triangle is cut short")
    return Geometry(vertices, np.arange(len(vertices)).reshape(-1, 3))


def read_xyz(file: BinaryIO, size: int) -> Geometry:
    """Points, one a line; of each line the first three numbers. Raises Damaged and ValueError."""
    numbers = array("d")
    for words in lines_of(file):
        if not words[0].startswith(b"#"):
            numbers.extend(_place((b" ".join(words).replace(b",", b" ").split() if b"," in words[0] else words)[:3]))
    return Geometry(vertices_of(numbers), np.empty((0, 3), np.int64))


def _place(words: list[bytes]) -> tuple[float, float, float]:
    if len(words) != 3:
        raise Damaged("a place of fewer than three numbers")
    return float(words[0]), float(words[1]), float(words[2])
