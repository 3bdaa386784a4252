"""Plots of lines and dots over a pair of axes; the same bytes for the same input."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

Colour = tuple[int, int, int]

COLOURS: tuple[Colour, ...] = (
    (31, 119, 180), (255, 127, 14), (44, 160, 44), (214, 39, 40), (148, 103, 189),
    (140, 86, 75), (227, 119, 194), (127, 127, 127), (188, 189, 34), (23, 190, 207),
)  # fmt: skip
GREY: Colour = (191, 191, 191)
INK, GRID, PAPER = (40, 40, 40), (225, 225, 225), (255, 255, 255)
LEFT, RIGHT, BOTTOM, LINE = 64, 20, 44, 18  # px: margins, and the height of a line of text
FINER = 2  # drawn so many times as large, for smooth edges
MARGIN = 0.05  # of an axis, beyond what it shows


@dataclass(frozen=True, eq=False)
class Series:
    """Points (x, y); those that are not finite are left out. Without a name it is not in the legend."""

    name: str
    x: Sequence[float] | np.ndarray
    y: Sequence[float] | np.ndarray
    colour: Colour
    line: bool = True
    dots: bool = False

    def finite(self) -> np.ndarray:
        """(n, 2)."""
        points = np.stack([np.asarray(self.x, float).ravel(), np.asarray(self.y, float).ravel()], -1)
        return np.asarray(points[np.isfinite(points).all(axis=1)])


class _Axis:
    """From values to 0-1, with ticks at round numbers."""

    def __init__(self, values: np.ndarray, *, logarithmic: bool = False, from_zero: bool = False) -> None:
        self.logarithmic = logarithmic
        low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
        if logarithmic:
            low, high = math.log10(low), math.log10(high)
        margin = MARGIN * (high - low) or 0.05 * abs(high) or 1.0
        self.low, self.high = 0.0 if from_zero else low - margin, high + margin

    def at(self, values: np.ndarray) -> np.ndarray:
        return np.asarray(((np.log10(values) if self.logarithmic else values) - self.low) / (self.high - self.low))

    def ticks(self) -> list[float]:
        if self.logarithmic:
            places = [digit * 10.0**power for power in range(math.floor(self.low), math.ceil(self.high) + 1) for digit in (1, 2, 5)]
            return [place for place in places if self.low <= math.log10(place) <= self.high]
        rough = (self.high - self.low) / 6
        power = 10.0 ** math.floor(math.log10(rough))
        step = next(digit * power for digit in (1, 2, 2.5, 5, 10) if digit * power >= rough)
        return [float(f"{number * step:.10g}") for number in range(math.ceil(self.low / step), math.floor(self.high / step) + 1)]


def plot(
    size: tuple[int, int], series: Sequence[Series], *, x_label: str, y_label: str, title: str = "", logarithmic: bool = False, from_zero: bool = False,
    notes: Sequence[tuple[float, float, str]] = (), right: Series | None = None,
) -> Image.Image:  # fmt: skip
    """A picture of series, the legend under the title.

    size         pixels
    logarithmic  the x axis
    notes        (x, y, text next to the point)
    right        a line with a y axis of its own, on the right, named as it is
    """
    every = np.concatenate([each.finite() for each in (*series, *(() if right is None else (right,)))] or [np.empty((0, 2))])
    x = _Axis(every[:, 0], logarithmic=logarithmic)
    y = _Axis(np.concatenate([each.finite()[:, 1] for each in series] or [np.empty(0)]), from_zero=from_zero)
    image = Image.new("RGB", (size[0] * FINER, size[1] * FINER), PAPER)
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(size=12 * FINER)
    names = [each for each in series if each.name]
    box = np.array([LEFT, LINE * (1 + bool(title) + bool(names)), size[0] - (LEFT if right else RIGHT), size[1] - BOTTOM]) * FINER

    def place(points: np.ndarray, axis: _Axis) -> list[tuple[float, float]]:
        across, up = x.at(points[:, 0]), axis.at(points[:, 1])
        return [(float(a), float(b)) for a, b in zip(box[0] + across * (box[2] - box[0]), box[3] - up * (box[3] - box[1]), strict=True)]

    for tick in x.ticks():
        at = box[0] + float(x.at(np.array(tick))) * (box[2] - box[0])
        draw.line([(at, box[1]), (at, box[3])], GRID, FINER)
        draw.text((at, box[3] + 4 * FINER), f"{tick:g}", INK, font, anchor="mt")
    for tick in y.ticks():
        at = box[3] - float(y.at(np.array(tick))) * (box[3] - box[1])
        draw.line([(box[0], at), (box[2], at)], GRID, FINER)
        draw.text((box[0] - 5 * FINER, at), f"{tick:g}", INK, font, anchor="rm")
    draw.rectangle([float(edge) for edge in box], outline=INK, width=FINER)
    for each in series:
        _draw(draw, each, place(each.finite(), y))
    if right is not None:
        axis = _Axis(right.finite()[:, 1])
        _draw(draw, right, place(right.finite(), axis))
        for tick in axis.ticks():
            draw.text((box[2] + 5 * FINER, box[3] - float(axis.at(np.array(tick))) * (box[3] - box[1])), f"{tick:g}", right.colour, font, anchor="lm")
        _upright(image, right.name, right.colour, font, size[0] - 10, size[1] // 2)
    for note_x, note_y, text in notes:
        (point,) = place(np.array([[note_x, note_y]]), y)
        near_end = point[0] > (box[0] + box[2]) / 2
        draw.text((point[0] + (-6 if near_end else 6) * FINER, point[1]), text, INK, font, anchor="rd" if near_end else "la")
    draw.text((size[0] * FINER / 2, 3 * FINER), title, INK, font, anchor="mt")
    draw.text(((box[0] + box[2]) / 2, (size[1] - 6) * FINER), x_label, INK, font, anchor="md")
    _upright(image, y_label, INK, font, 10, size[1] // 2)
    _legend(draw, names, float(box[0]), float(box[1]), font)
    return image.resize(size, Image.Resampling.BOX)


def _draw(draw: ImageDraw.ImageDraw, series: Series, places: list[tuple[float, float]]) -> None:
    if series.line:
        draw.line(places, series.colour, round(1.4 * FINER), joint="curve")
    for x, y in places if series.dots else ():
        draw.ellipse([x - 3 * FINER, y - 3 * FINER, x + 3 * FINER, y + 3 * FINER], series.colour)


def _legend(draw: ImageDraw.ImageDraw, named: Sequence[Series], at: float, y: float, font: ImageFont.FreeTypeFont | ImageFont.ImageFont) -> None:
    for each in named:
        draw.rectangle([at, y - 12 * FINER, at + 12 * FINER, y - 6 * FINER], each.colour)
        draw.text((at + 16 * FINER, y - 9 * FINER), each.name, INK, font, anchor="lm")
        at += draw.textlength(each.name, font) + 30 * FINER


def _upright(image: Image.Image, text: str, colour: Colour, font: ImageFont.FreeTypeFont | ImageFont.ImageFont, x: int, y: int) -> None:
    """Text from below to above, its middle at (x, y) pixels of the finished picture."""
    _, _, right, bottom = font.getbbox(text)
    mask = Image.new("L", (max(1, round(right)), max(1, round(bottom))))
    ImageDraw.Draw(mask).text((0, 0), text, 255, font)
    turned = mask.rotate(90, expand=True)
    image.paste(colour, (x * FINER - turned.width // 2, y * FINER - turned.height // 2), turned)


def heat(values: np.ndarray, colours: Sequence[Colour]) -> np.ndarray:
    """(..., 3) uint8: values 0 to 1 as colours, evenly spaced and mixed between."""
    at = np.linspace(0, 1, len(colours))
    return np.stack([np.interp(values, at, [colour[k] for colour in colours]) for k in range(3)], -1).round().astype(np.uint8)


# Of matplotlib's, which everybody reads; every ninth or so.
INFERNO: tuple[Colour, ...] = (
    (0, 0, 4), (27, 12, 65), (74, 12, 107), (120, 28, 109), (165, 44, 96), (207, 68, 70), (237, 105, 37), (251, 155, 6), (247, 209, 61), (252, 255, 164),
)  # fmt: skip
VIRIDIS: tuple[Colour, ...] = (
    (68, 1, 84), (72, 40, 120), (62, 73, 137), (49, 104, 142), (38, 130, 142), (31, 158, 137), (53, 183, 121), (110, 206, 88), (181, 222, 43), (253, 231, 37),
)  # fmt: skip
