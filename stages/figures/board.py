"""A sheet of markers to print and lay next to the subject, with a ruler that shows whether the printer scaled it."""

import time
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from pipeline.errors import UsageError
from pipeline.files import atomic

DICTIONARY = "APRILTAG_36h11"
PAPERS = {"a4": (210.0, 297.0), "letter": (215.9, 279.4)}  # mm
DPI = 600
CELLS = 8  # along a marker's edge
MARGIN, FOOT, GAP, RULER = 12.0, 38.0, 0.25, 100  # mm; mm below the markers; of an edge, white between markers; mm
_EPOCH = time.gmtime(0)  # so that the same board has the same bytes


def draw_board(paper: str, size: float) -> Image.Image:
    """The sheet at DPI, black and white; markers with edges of `size` mm. Raises UsageError where fewer than three fit."""
    width, height = PAPERS[paper]
    columns, rows = (int((side - 2 * MARGIN + GAP * size) // ((1 + GAP) * size)) for side in (width, height - FOOT))
    if columns * rows < 3:
        raise UsageError(f"--marker-size: fewer than three markers of {size:g} mm fit on {paper}. Give a smaller size.")
    sheet = Image.new("1", (_px(width), _px(height)), 1)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{DICTIONARY}"))
    left = (width - (columns + GAP * (columns - 1)) * size) / 2
    for number in range(min(rows * columns, len(dictionary.bytesList))):
        cells = Image.fromarray(np.asarray(cv2.aruco.generateImageMarker(dictionary, number, CELLS)))
        row, column = divmod(number, columns)
        corner = _px(left + column * (1 + GAP) * size), _px(MARGIN + row * (1 + GAP) * size)
        sheet.paste(cells.resize((_px(size), _px(size)), Image.Resampling.NEAREST).convert("1"), corner)
    _draw_foot(ImageDraw.Draw(sheet), height - FOOT, size)
    return sheet


def write_board(path: Path, paper: str, size: float) -> None:
    """The sheet as PDF or PNG, by the name of the file, in its true size."""
    sheet = draw_board(paper, size)
    with atomic(path) as aside:
        if path.suffix.lower() == ".pdf":
            sheet.save(aside, "PDF", resolution=DPI, title=DICTIONARY, creationDate=_EPOCH, modDate=_EPOCH)
        else:
            sheet.save(aside, "PNG", dpi=(DPI, DPI))


def _draw_foot(draw: ImageDraw.ImageDraw, top: float, size: float) -> None:
    font = ImageFont.load_default(_px(3.2))
    for mm in range(RULER + 1):
        x, length = _px(MARGIN + mm), 6 if mm % 10 == 0 else 4 if mm % 5 == 0 else 2.5
        draw.line([(x, _px(top)), (x, _px(top + length))], fill=0, width=_px(0.15))
        if mm % 10 == 0:
            draw.text((x, _px(top + 6.5)), f"{mm}" if mm < RULER else f"{mm} mm", fill=0, font=font, anchor="ma")
    lines = (
        f"Print at 100 % (not \"fit to page\"). The ruler must measure {RULER} mm; if not, measure a black edge and give that length.",
        "Keep the sheet flat and still next to the subject, and leave it in the pictures from all sides.",
        f"enerf run PHOTOS --out RUN --marker-size {size:g}mm          {DICTIONARY}",
    )
    for number, line in enumerate(lines):
        draw.text((_px(MARGIN), _px(top + 12 + 5 * number)), line, fill=0, font=font)


def _px(mm: float) -> int:
    return round(mm * DPI / 25.4)
