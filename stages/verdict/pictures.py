"""Pictures of what structure from motion found: cameras from above and from the side, which photographs match, and photographs by sharpness."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from stages.figures.plots import grid_sheet
from stages.io.photo import apply_exif_orientation
from stages.io.pictures import UnreadableImage, opened, orientation_of
from stages.io.png import write_png

PANEL = 520  # px
MARGIN = 16
POINTS = 4000  # sparse points that are drawn
PAPER, INK, GREY, LOST, GOOD = (255, 255, 255), (32, 32, 32), (186, 190, 196), (200, 40, 40), (35, 100, 170)
BORDER = 1.25  # of the box that is shown
REACH, MOST_POINTS = 2.0, 0.95  # of the cameras' own box, that points may widen it to; quantile of the points, along each axis
MOST_SHEET = 48  # photographs of the sheet by sharpness
CELL = 900  # px, of the picture of matches, at most


def camera_plot(centres: np.ndarray, forward: np.ndarray, points: np.ndarray, lost: np.ndarray, title: str, path: Path) -> None:
    """Write a PNG with the cameras from above and from the side: a dot each with a line along its view direction, lost ones in red.

    centres, forward  (C, 3) z up; unit view directions
    points            (N, 3) sparse points
    lost              (L, 3) about where photographs without a camera were taken
    """
    sheet = Image.new("RGB", (2 * PANEL + 3 * MARGIN, PANEL + 3 * MARGIN + 20), PAPER)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=12)
    draw.text((MARGIN, MARGIN), title, INK, font)
    low, high = shown_box(np.concatenate([centres, lost]), points)
    middle, half = (low + high) / 2, max(float((high - low).max()) / 2, 1e-9) * BORDER
    some = points[:: max(1, len(points) // POINTS)]
    for panel, (name, axes) in enumerate((("from above", [0, 1]), ("from the side", [0, 2]))):
        left, top = MARGIN + panel * (PANEL + MARGIN), 2 * MARGIN + 20
        shown = ((xyz - middle)[:, axes] / half * (0.5, -0.5) for xyz in (some, centres, centres + 0.09 * half * forward, lost))  # (N, 2) each, y down
        _draw_panel(draw, (left, top), *((left, top) + PANEL * (0.5 + each) for each in shown))
        draw.text((left + 6, top + 4), name, INK, font)
    write_png(np.asarray(sheet), path)


def shown_box(cameras: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners (3,) of the box round cameras (C, 3) and most of the points (N, 3) that they look at: what lies to one side of them is shown too, but not what is
    so far away that the cameras would be a speck."""
    if not len(cameras):
        return np.zeros(3), np.zeros(3)
    low, high = cameras.min(0), cameras.max(0)
    if len(points):
        middle, reach = (low + high) / 2, REACH * float((high - low).max()) / 2
        nearest, farthest = np.quantile(points, [1 - MOST_POINTS, MOST_POINTS], axis=0)
        low, high = np.minimum(low, np.maximum(nearest, middle - reach)), np.maximum(high, np.minimum(farthest, middle + reach))
    return low, high


def _draw_panel(draw: Any, corner: tuple[int, int], points: np.ndarray, centres: np.ndarray, ends: np.ndarray, lost: np.ndarray) -> None:
    left, top = corner
    draw.rectangle((left, top, left + PANEL, top + PANEL), outline=GREY)
    for x, y in points.tolist():
        if left < x < left + PANEL and top < y < top + PANEL:
            draw.point((x, y), GREY)
    for (x, y), (u, v) in zip(centres.tolist(), ends.tolist(), strict=True):
        draw.line((x, y, u, v), GOOD, 1)
        draw.ellipse((x - 2.5, y - 2.5, x + 2.5, y + 2.5), GOOD)
    for x, y in lost.tolist():
        draw.ellipse((x - 4, y - 4, x + 4, y + 4), outline=LOST, width=2)


def lost_places(names: Sequence[str], centres: np.ndarray, lost: Sequence[str], overlaps: Sequence[tuple[str, str, int]]) -> np.ndarray:
    """(L, 3) of each lost photograph that matches any that is placed: the mean of their centres, by the number of matches."""
    place = {name: index for index, name in enumerate(names)}
    found = []
    for name in lost:
        near = [(place[b if a == name else a], count) for a, b, count in overlaps if name in (a, b) and (b if a == name else a) in place]
        if near:
            found.append(np.average(centres[[index for index, _ in near]], axis=0, weights=[count for _, count in near]))
    return np.array(found).reshape(-1, 3)


def match_picture(names: Sequence[str], lost: Sequence[str], overlaps: Sequence[tuple[str, str, int]], path: Path) -> None:
    """Write a PNG of a square a pair of photographs, in order of name: the darker, the more matches; rows and columns of lost ones are red."""
    place = {name: index for index, name in enumerate(names)}
    counts = np.zeros((len(names), len(names)))
    for a, b, count in overlaps:
        if a in place and b in place:
            counts[place[a], place[b]] = counts[place[b], place[a]] = count
    shade = np.clip(np.log2(np.maximum(counts, 1.0)) / 9.0, 0.0, 1.0)[..., None]
    ink, paper = (np.full((len(names), len(names), 3), colour, np.float64) for colour in (GOOD, PAPER))
    for name in lost:
        if name in place:
            for rows in (np.s_[place[name], :], np.s_[:, place[name]]):
                ink[rows], paper[rows] = LOST, (252, 232, 232)
    pixels = np.rint(paper + shade * (ink - paper)).astype(np.uint8)
    size = max(1, min(16, CELL // max(1, len(names))))
    pixels = np.repeat(np.repeat(pixels, size, axis=0), size, axis=1)
    width = max(pixels.shape[1], 420)
    sheet = Image.new("RGB", (width + 2 * MARGIN, pixels.shape[0] + 2 * MARGIN + 40), PAPER)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=12)
    draw.text((MARGIN, 8), f"Matches between {len(names)} photographs in order of name; red: without a camera", INK, font)
    draw.text((MARGIN, 24), f"{names[0]} ... {names[-1]}" if names else "", INK, font)
    sheet.paste(Image.fromarray(pixels), (MARGIN, MARGIN + 32))
    write_png(np.asarray(sheet), path)


def sharpness_sheet(files: Mapping[str, Path], sharpness: Mapping[str, float], blurred: Sequence[str], path: Path) -> None:
    """Write a sheet of photographs, the most blurred first; of many all that are blurred, as far as they fit, and an even choice of the others."""
    ordered = sorted((name for name in files if name in sharpness), key=lambda name: (sharpness[name], name))
    chosen = [name for name in ordered if name in set(blurred)][: MOST_SHEET // 2]
    others = [name for name in ordered if name not in set(chosen)]
    chosen += others[:: max(1, -(-len(others) // max(1, MOST_SHEET - len(chosen))))]
    pictures, labels = [], []
    for name in sorted(chosen, key=lambda name: (sharpness[name], name)):
        try:
            with opened(files[name]) as image:
                image.draft("RGB", (400, 400))
                orientation = orientation_of(image)
                pixels = np.asarray(image.convert("RGBA" if image.mode in ("RGBA", "LA", "PA", "P") else "RGB"))
        except UnreadableImage:
            continue
        pictures.append(apply_exif_orientation(pixels, orientation))
        labels.append(f"{sharpness[name]:.2f}{' blurred' if name in set(blurred) else ''} {name}")
    if pictures:
        title = f"{len(ordered)} photographs by sharpness, the most blurred first; {len(blurred)} blurred"
        grid_sheet(pictures, labels, path, title=title)
