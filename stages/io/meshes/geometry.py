"""The shape that a file holds, and what may be wrong with one. N vertices, F triangles."""

import os
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from pipeline.errors import BadInput
from pipeline.files import Unreadable, open_plain

AT_ONCE = 2**16  # rows
MAX_LINE = 2**20  # bytes of a line: a polygon of a hundred thousand corners


class Damaged(ValueError):
    """What is wrong, for a message that names the file."""


@dataclass(frozen=True)
class Geometry:
    """Part of a file, or all of it."""

    vertices: np.ndarray  # (N, 3) float64
    triangles: np.ndarray  # (F, 3) int64, places in `vertices`
    colours: np.ndarray | None = None  # (N, 3) uint8, or None

    def __post_init__(self) -> None:
        if len(self.triangles) and (self.triangles.min() < 0 or self.triangles.max() >= len(self.vertices)):
            raise Damaged(f"faces of vertices that are none of its {len(self.vertices)}")

    def is_watertight(self) -> bool:
        """Whether every edge has two faces, vertices at one place taken for one."""
        order = np.lexsort(self.vertices.T)
        ids = np.empty(len(order), np.int64)
        ids[order] = np.cumsum((np.diff(self.vertices[order], axis=0, prepend=self.vertices[order[:1]]) != 0).any(axis=1))
        faces = ids[self.triangles]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        edges = np.concatenate([np.minimum(a, b) * len(ids) + np.maximum(a, b) for a, b in zip(faces.T, np.roll(faces, 1, axis=1).T, strict=True)])  # (3 F,)
        edges.sort()
        return len(edges) > 0 and len(edges) % 2 == 0 and bool((edges[::2] == edges[1::2]).all() and (edges[1:-1:2] != edges[2::2]).all())


@contextmanager
def opened(path: Path) -> Iterator[tuple[BinaryIO, int]]:
    """A file to be described, and its size. Whatever shows it to be damaged raises BadInput."""
    try:
        with open(open_plain(path), "rb") as file:
            yield file, os.fstat(file.fileno()).st_size
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror or error}).") from error
    except (Damaged, Unreadable) as error:
        raise BadInput(f"{path}: {error}. Write the file again with the program that made it.") from error
    except (ValueError, OverflowError, struct.error) as error:  # numbers that are none
        raise BadInput(f"{path}: cannot be read as {path.suffix} ({' '.join(str(error).split())[:200]}).") from error


def triangles_of(corners: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """(F, 3) of polygons: the corners of all of them one after another, and how many each has. Each is a fan round its first corner."""
    if len(corners) >= 2**31:
        raise Damaged("faces of 2^31 corners")
    sizes = sizes.astype(np.int32)
    fans = np.maximum(sizes - 2, 0)
    first = np.repeat(np.cumsum(sizes, dtype=np.int32) - sizes, fans)
    second = first + np.arange(1, 1 + len(first), dtype=np.int32) - np.repeat(np.cumsum(fans, dtype=np.int32) - fans, fans)
    return np.stack([corners[place].astype(np.int64) for place in (first, second, second + 1)], axis=1)


def vertices_of(numbers: Sequence[float]) -> np.ndarray:
    """(N, 3) of their numbers one after another."""
    return np.array(numbers, np.float64).reshape(-1, 3)


def lines_of(file: BinaryIO) -> Iterator[list[bytes]]:
    """The words of each line that has any. Raises Damaged for a line that is too long."""
    while line := file.readline(MAX_LINE):
        if len(line) == MAX_LINE:
            raise Damaged(f"a line of more than {MAX_LINE} bytes")
        if words := line.split():
            yield words


def exactly(file: BinaryIO, count: int) -> bytes:
    """So many bytes. Raises Damaged where there are fewer."""
    data = file.read(count)
    if len(data) != count:
        raise Damaged("it is cut short")
    return data
