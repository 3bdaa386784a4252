"""Contact sheets, error maps and curves; the same bytes for the same input."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from pipeline.files import atomic
from stages.figures.drawing import matplotlib, new_figure
from stages.io.png import read_png, write_png

MARGIN = 8
LABEL_HEIGHT = 18
BACKGROUND = (255, 255, 255)
TEXT = (32, 32, 32)


def contact_sheet(rows: Sequence[Sequence[np.ndarray]], labels: Sequence[Sequence[str]], path: Path, *, thumbnail: int, title: str = "") -> None:
    """Write a PNG with rows of thumbnails, a label under each.

    rows       images of any size: (H, W), (H, W, 3) or (H, W, 4), uint8 or floating point 0 to 1, sRGB. Rows may differ in length.
    labels     one text for each image; long ones are elided in the middle
    thumbnail  longest side of the thumbnails, pixels; smaller images are enlarged to it
    """
    if not any(len(row) for row in rows):
        raise ValueError(f"{path}: a contact sheet of no images")
    thumbnails = [[thumbnail_of(image, thumbnail) for image in row] for row in rows]
    cell_w = max(image.width for row in thumbnails for image in row)
    heights = [max((image.height for image in row), default=0) for row in thumbnails]
    top = MARGIN + (LABEL_HEIGHT + MARGIN if title else 0)
    columns = max(len(row) for row in rows)
    sheet = Image.new("RGB", (MARGIN + columns * (cell_w + MARGIN), top + sum(height + LABEL_HEIGHT + MARGIN for height in heights)), BACKGROUND)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=12)
    if title:
        draw.text((MARGIN, MARGIN), _fitted(title, sheet.width - 2 * MARGIN, draw, font), TEXT, font)
    for i, row in enumerate(thumbnails):
        for j, image in enumerate(row):
            x = MARGIN + j * (cell_w + MARGIN)
            sheet.paste(image, (x + (cell_w - image.width) // 2, top))
            if labels[i][j]:
                draw.text((x, top + heights[i] + 2), _fitted(labels[i][j], cell_w, draw, font), TEXT, font)
        top += heights[i] + LABEL_HEIGHT + MARGIN
    write_png(np.asarray(sheet), path)


def grid_sheet(images: Sequence[np.ndarray], labels: Sequence[str], path: Path, *, title: str) -> None:
    """A contact sheet of one list of images, row by row, about 3:2."""
    columns = max(1, min(len(images), int(np.ceil(np.sqrt(len(images) * 1.5)))))
    starts = range(0, len(images), columns)
    contact_sheet([images[s : s + columns] for s in starts], [labels[s : s + columns] for s in starts], path, thumbnail=160, title=title)


def thumbnail_of(image: np.ndarray, longest: int) -> Image.Image:
    """A PIL RGB image whose longest side is `longest`; transparency is composited on light grey."""
    pixels = to_uint8(image)
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[:, :, None], 3, axis=2)
    resized = Image.fromarray(np.ascontiguousarray(pixels))
    scale = longest / max(resized.size)
    size = (max(1, round(resized.width * scale)), max(1, round(resized.height * scale)))
    resized = resized.resize(size, Image.Resampling.LANCZOS if scale < 1 else Image.Resampling.NEAREST)
    if resized.mode == "RGBA":
        paper = Image.new("RGBA", resized.size, (224, 224, 224, 255))
        resized = Image.alpha_composite(paper, resized)
    return resized.convert("RGB")


def to_uint8(image: np.ndarray) -> np.ndarray:
    """uint8 of an image whose floating-point values run from 0 to 1 (clipped, rounded to nearest, nan is 0); uint8 passes through."""
    image = np.asarray(image)
    if image.dtype == np.uint8:
        return image
    if not np.issubdtype(image.dtype, np.floating) and image.dtype != np.bool_:
        raise ValueError(f"an image of {image.dtype}: expected uint8 or floating point 0 to 1")
    return (np.clip(np.nan_to_num(image.astype(np.float32)), 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def error_map(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Mean absolute difference over the channels as colours: black for none, light yellow for 0.25 and more.

    image, truth  (H, W, 3) floating point 0 to 1
    returns       (H, W, 3) uint8
    """
    error = np.abs(image - truth).mean(axis=2)
    return np.asarray(to_uint8(matplotlib().colormaps["inferno"](np.clip(error / 0.25, 0.0, 1.0))[:, :, :3]))


def curve(path: Path, series: Mapping[str, tuple[Sequence[float], Sequence[float]]], *, x_label: str, y_label: str, title: str = "") -> None:
    """Write a PNG of curves over one axis.

    series  name -> (x, y) of equal length; values that are not finite are left out
    """
    figure, canvas = new_figure(8.0, 4.5, 100)
    axes = figure.add_subplot()
    for name, (x, y) in series.items():
        xs, ys = np.asarray(x, float), np.asarray(y, float)
        finite = np.isfinite(xs) & np.isfinite(ys)
        axes.plot(xs[finite], ys[finite], label=name, linewidth=1.2, marker="." if finite.sum() < 20 else None)
    axes.set(xlabel=x_label, ylabel=y_label, title=title)
    axes.grid(alpha=0.3)
    if series:
        axes.legend(frameon=False)
    # without the program's name and version, for the same bytes
    canvas.print_png(path, metadata={"Software": None})


def with_palette(path: Path) -> None:
    """Write a plot's PNG again with a palette: half the bytes or fewer, for a document; thin lines keep their colours to within a few of 255 levels."""
    plain = Image.fromarray(np.ascontiguousarray(read_png(path)[..., :3]))
    with atomic(path) as temporary:
        plain.quantize(128, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(temporary, "PNG", optimize=True)


def _fitted(text: str, width: int, draw: object, font: object) -> str:
    """The text, its middle replaced by an ellipsis where it is wider than `width` pixels."""
    length = draw.textlength  # type: ignore[attr-defined]
    if length(text, font=font) <= width:
        return text
    for kept in range(len(text) - 1, 1, -1):
        shorter = text[: (kept + 1) // 2] + "…" + text[len(text) - kept // 2 :]
        if length(shorter, font=font) <= width:
            return shorter
    return "…"
