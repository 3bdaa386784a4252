"""Contact sheet of a scene: thumbnails of all images by split, and of the rejected ones."""

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageOps

from pipeline.text import printable
from stages.artifacts import PosesOutputs
from stages.figures.plots import contact_sheet
from stages.io.pictures import UnreadableImage, opened
from stages.io.scene import SPLITS, Scene

THUMBNAIL = 144  # px, longest side
FRAME = 3  # px
COLUMNS = 8
MAX_THUMBNAILS = 240  # of larger captures every n-th image is shown
COLOURS = {"train": (70, 130, 180), "val": (218, 165, 32), "test": (60, 160, 75), "rejected": (200, 40, 40)}


def write_contact_sheet(scene: Scene, folder: Path, rejected: Sequence[tuple[str, str]], files: Mapping[str, Path]) -> None:
    """Write the contact sheet of the folder of a scene: thumbnails framed in the colour of their split, names below; rejected ones crossed out, at the end.

    rejected  (name, reason) of each
    files     name -> file of those that have a picture; names themselves are never opened, they may be anybody's
    """
    entries: list[tuple[Path | None, str, str]] = [(folder / view.image, view.name, view.split) for view in scene.views]
    every = -(-len(entries) // MAX_THUMBNAILS)
    counts = {split: sum(entry[2] == split for entry in entries) for split in SPLITS} | {"rejected": len(rejected)}
    title = f"{len(entries)} images: " + ", ".join(f"{count} {what}" for what, count in counts.items() if count)
    shown = entries[::every] + [(files.get(name), name, "rejected") for name, _ in rejected[: MAX_THUMBNAILS // 4]]
    rows = [shown[first : first + COLUMNS] for first in range(0, len(shown), COLUMNS)]
    contact_sheet(
        [[_framed(path, split) for path, _, split in row] for row in rows],
        [[printable(f"{name} {split}") for _, name, split in row] for row in rows],
        PosesOutputs(folder).contact_sheet,
        thumbnail=THUMBNAIL + 2 * FRAME,
        title=title + (f" (every {every}th shown)" if every > 1 else ""),
    )


def _framed(path: Path | None, split: str) -> np.ndarray:
    """Longest side at most THUMBNAIL within the frame; grey without an image."""
    picture: Any = Image.new("RGB", (THUMBNAIL, THUMBNAIL * 3 // 4), (200, 200, 200))
    if path is not None:
        with contextlib.suppress(UnreadableImage), opened(path) as image:
            image.draft("RGB", (2 * THUMBNAIL, 2 * THUMBNAIL))
            upright = ImageOps.exif_transpose(image)
            upright.thumbnail((THUMBNAIL, THUMBNAIL))
            picture = upright.convert("RGBA" if upright.mode in ("RGBA", "LA", "P", "PA") else "RGB")
    framed = ImageOps.expand(picture, FRAME, COLOURS[split])
    if split == "rejected":
        draw, right, bottom = ImageDraw.Draw(framed), framed.width - 1, framed.height - 1
        draw.line((0, 0, right, bottom), fill=COLOURS[split], width=FRAME)
        draw.line((0, bottom, right, 0), fill=COLOURS[split], width=FRAME)
    return np.asarray(framed)
