"""PNG files: the same pixels are the same bytes, and a file that is there is whole."""

from pathlib import Path

import numpy as np
from PIL import Image

from pipeline.files import atomic
from stages.io.pictures import opened

FAST = 1  # compression of what is read once and thrown away
USUAL = 6


def write_png(pixels: np.ndarray, path: Path, *, compress_level: int = USUAL, durable: bool = True, exif: Image.Exif | None = None) -> None:
    """Write (H, W), (H, W, 3) or (H, W, 4) uint8; see `pipeline.files.atomic`."""
    with atomic(path, durable=durable) as temporary:
        Image.fromarray(np.ascontiguousarray(pixels)).save(temporary, "PNG", compress_level=compress_level, exif=exif)


def read_png(path: Path) -> np.ndarray:
    """uint8, in the shape that `write_png` was given; raises UnreadableImage."""
    with opened(path, ("PNG",)) as image:
        image.load()  # here, and not within NumPy, which takes some errors for another kind of object
        return np.asarray(image)
