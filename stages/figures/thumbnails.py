"""Small pictures of runs, for pages that show many."""

from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

from pipeline.files import atomic
from stages.figures.plots import thumbnail_of
from stages.io.pictures import opened, rgb_and_alpha

WIDTH, HEIGHT = 192, 144  # pixels: twice what a page shows
QUALITY = 70


def write_thumbnail(picture: Path, target: Path) -> None:
    """A WebP of 4:3 from the middle of a picture file, a few kB. Raises UnreadableImage; see `pipeline.files.atomic`."""
    with opened(picture) as image:
        image.draft("RGB", (2 * WIDTH, 2 * HEIGHT))  # a JPEG is decoded at a part of its size
        rgb, alpha = rgb_and_alpha(image)
    if alpha is not None:
        rgb = np.dstack([rgb, alpha])
    small = ImageOps.fit(thumbnail_of(rgb, 2 * WIDTH), (WIDTH, HEIGHT), Image.Resampling.LANCZOS)
    with atomic(target, durable=False) as temporary:
        small.save(temporary, "WEBP", quality=QUALITY)
