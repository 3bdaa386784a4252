"""The textures of exported meshes: pictures as files, vertices that are split where a texture has its seams, and names that every reader takes."""

from __future__ import annotations

import hashlib
import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from efficientnerf.surface.mesh import Mesh

Picture = Literal["png", "jpeg"]  # how textures are stored
EXTENSIONS: dict[Picture, str] = {"png": ".png", "jpeg": ".jpg"}
MIME: dict[Picture, str] = {"png": "image/png", "jpeg": "image/jpeg"}
JPEG_QUALITY = 92


@dataclass(frozen=True, eq=False)
class Corners:
    """A mesh whose vertices have one texture coordinate each.

    vertex       (N,) int64, the vertex of the mesh that each is a copy of; ascending
    coordinates  (N, 2) float32, v up
    faces        (F, 3) int64 of these
    """

    vertex: np.ndarray
    coordinates: np.ndarray
    faces: np.ndarray


def split_at_seams(mesh: Mesh) -> Corners:
    """The mesh with a vertex for each pair of a vertex and a texture coordinate; its texture must not be None. Vertices without a face are left out."""
    assert mesh.texture is not None
    coordinates = np.ascontiguousarray(mesh.texture.coordinates.reshape(-1, 2), np.float32) + np.float32(0)  # no negative zeros
    place = coordinates.view(np.uint64).ravel()  # both numbers as one
    vertex = mesh.faces.ravel()
    order = np.lexsort((place, vertex))
    begins = np.ones(len(order), bool)
    begins[1:] = (np.diff(vertex[order]) != 0) | (place[order][1:] != place[order][:-1])
    faces = np.empty(len(order), np.int64)
    faces[order] = np.cumsum(begins) - 1
    first = order[begins]
    return Corners(vertex[first], coordinates[first], faces.reshape(-1, 3))


def encoded(pixels: np.ndarray, picture: Picture) -> bytes:
    """(H, W, 3) uint8 as a file: the same pixels are the same bytes."""
    from PIL import Image

    file = io.BytesIO()
    image = Image.fromarray(np.ascontiguousarray(pixels))
    if picture == "jpeg":
        image.save(file, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    else:
        image.save(file, "PNG", compress_level=6)
    return file.getvalue()


def plain_stem(path: Path) -> str:
    """The stem of a file as readers of OBJ and MTL take it in a reference: letters of ASCII, digits, dots, dashes and underscores alone. Where that is another
    stem, a hash of the true one keeps names apart."""
    stem = path.stem
    plain = re.sub(r"[^A-Za-z0-9._-]+", "_", stem).lstrip(".-")[:100]
    return plain if plain == stem else f"{plain or '_'}-{hashlib.sha256(stem.encode('utf-8', 'surrogateescape')).hexdigest()[:8]}"


def open_faces(faces: np.ndarray) -> bool:
    """Whether some edge has a face on one side alone."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    key = np.sort(edges[:, 0] * (int(faces.max()) + 1) + edges[:, 1])
    ends = np.flatnonzero(np.diff(key, prepend=-1, append=-1))
    return bool((np.diff(ends) == 1).any())
