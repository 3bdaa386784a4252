"""The texture of an exported mesh: a picture as a file, and names that every reader takes."""

import hashlib
import io
import re
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image

from efficientnerf.surface.mesh import Mesh, Texture

Picture = Literal["png", "jpeg"]  # how textures are stored
EXTENSIONS: dict[Picture, str] = {"png": ".png", "jpeg": ".jpg"}
MIME: dict[Picture, str] = {"png": "image/png", "jpeg": "image/jpeg"}
JPEG_QUALITY = 92


def encoded(pixels: np.ndarray, picture: Picture) -> bytes:
    """(H, W, 3) uint8 as a file: the same pixels are the same bytes."""
    file = io.BytesIO()
    image = Image.fromarray(np.ascontiguousarray(pixels))
    if picture == "jpeg":
        image.save(file, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    else:
        image.save(file, "PNG", compress_level=6)
    return file.getvalue()


def plain_stem(path: Path) -> str:
    """The stem of a file as readers of OBJ and MTL take it in a reference: letters of ASCII, digits, dots, dashes and underscores alone. A changed
    stem gets a hash of the true one, to keep names apart."""
    stem = path.stem
    plain = re.sub(r"[^A-Za-z0-9._-]+", "_", stem).lstrip(".-")[:100]
    return plain if plain == stem else f"{plain or '_'}-{hashlib.sha256(stem.encode('utf-8', 'surrogateescape')).hexdigest()[:8]}"


def companions(path: Path, picture: Picture) -> list[Path]:
    """The file of a mesh's texture that is written next to it."""
    return [path.with_name(plain_stem(path) + EXTENSIONS[picture])]


@lru_cache(maxsize=1)  # several formats of one mesh follow each other
def picture_of(mesh: Mesh, picture: Picture) -> bytes | None:
    """The same as bytes; None of a mesh without a texture."""
    return None if mesh.texture is None else encoded(mesh.texture.colours, picture)


def distinct_places(texture: Texture) -> tuple[np.ndarray, np.ndarray]:
    """(P, 2) float32 the different texture coordinates, and (F, 3) which of them each corner has."""
    places = np.ascontiguousarray(texture.coordinates.reshape(-1, 2), np.float32) + np.float32(0)
    _, first, number = np.unique(places.view(np.uint64).ravel(), return_index=True, return_inverse=True)
    return places[first], number.reshape(-1, 3)


def open_faces(faces: np.ndarray) -> bool:
    """Whether some edge has a face on one side alone."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    key = np.sort(edges[:, 0] * (int(faces.max()) + 1) + edges[:, 1])
    ends = np.flatnonzero(np.diff(key, prepend=-1, append=-1))
    return bool((np.diff(ends) == 1).any())
