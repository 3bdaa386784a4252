"""One picture of all images of a scene: what is used for what, and what could not be used."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stages.scene import Scene

THUMBNAIL = 144  # px, longest side
MARGIN, LABEL = 6, 26  # px
COLUMNS = 8
MOST = 240  # thumbnails; larger captures are thinned evenly
COLOURS = {"train": (70, 130, 180), "val": (218, 165, 32), "test": (60, 160, 75), "rejected": (200, 40, 40)}


def write_contact_sheet(scene: Scene, folder: Path, rejected: Sequence[tuple[str, str]], source: Path) -> None:
    """Write folder/contact_sheet.png: thumbnails framed in the colour of their split, names below, the rejected ones crossed out last."""
    from PIL import Image, ImageDraw

    entries: list[tuple[Path | None, str, str]] = [(folder / view.image, view.name, view.split) for view in scene.views]
    thinned = entries[:: -(-len(entries) // MOST)]
    thinned += [(_readable(source / name), name, "rejected") for name, _ in rejected[: MOST // 4]]
    cell = THUMBNAIL + 2 * MARGIN
    rows = -(-len(thinned) // COLUMNS)
    counts = {split: sum(entry[2] == split for entry in entries) for split in ("train", "val", "test")} | {"rejected": len(rejected)}
    title = f"{len(entries)} images: " + ", ".join(f"{count} {what}" for what, count in counts.items() if count)
    sheet = Image.new("RGB", (COLUMNS * cell, rows * (cell + LABEL) + LABEL), (255, 255, 255))
    draw = ImageDraw.Draw(sheet)
    draw.text((MARGIN, MARGIN), title + (f" (every {-(-len(entries) // MOST)}th shown)" if len(entries) > MOST else ""), fill=(0, 0, 0))
    for index, (path, name, split) in enumerate(thinned):
        left, top = index % COLUMNS * cell, index // COLUMNS * (cell + LABEL) + LABEL
        thumbnail = _thumbnail(path)
        box = (left + MARGIN, top + MARGIN, left + MARGIN + thumbnail.width, top + MARGIN + thumbnail.height)
        sheet.paste(thumbnail, box[:2], thumbnail if thumbnail.mode == "RGBA" else None)
        draw.rectangle((box[0] - 3, box[1] - 3, box[2] + 2, box[3] + 2), outline=COLOURS[split], width=3)
        if split == "rejected":
            draw.line((*box[:2], *box[2:]), fill=COLOURS[split], width=3)
            draw.line((box[0], box[3], box[2], box[1]), fill=COLOURS[split], width=3)
        short = name if len(name) <= 22 else "..." + name[-19:]
        draw.text((left + MARGIN, top + cell - 2), short.encode("latin-1", "replace").decode("latin-1"), fill=(0, 0, 0))
        draw.text((left + MARGIN, top + cell + 9), split, fill=COLOURS[split])
    sheet.save(folder / "contact_sheet.png", compress_level=6)


def _readable(path: Path) -> Path | None:
    return path if path.is_file() else None


def _thumbnail(path: Path | None) -> Any:
    """At most THUMBNAIL to a side; grey where there is nothing to show."""
    from PIL import Image, ImageOps

    if path is not None:
        try:
            with Image.open(path) as image:
                image.draft("RGB", (2 * THUMBNAIL, 2 * THUMBNAIL))
                upright = ImageOps.exif_transpose(image)
                upright.thumbnail((THUMBNAIL, THUMBNAIL))
                return upright.convert("RGBA" if upright.mode in ("RGBA", "LA", "P", "PA") else "RGB")
        except Exception:
            pass  # rejected because it cannot be read, most likely
    return Image.new("RGB", (THUMBNAIL, THUMBNAIL * 3 // 4), (200, 200, 200))
