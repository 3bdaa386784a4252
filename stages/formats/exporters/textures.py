"""The textures of exported meshes: pictures as files, and names that every reader takes."""

from __future__ import annotations

import hashlib
import io
import re
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image

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


def open_faces(faces: np.ndarray) -> bool:
    """Whether some edge has a face on one side alone."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    key = np.sort(edges[:, 0] * (int(faces.max()) + 1) + edges[:, 1])
    ends = np.flatnonzero(np.diff(key, prepend=-1, append=-1))
    return bool((np.diff(ends) == 1).any())
