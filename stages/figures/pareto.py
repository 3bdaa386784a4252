"""Quality over cost: which choices no other beats in both, and a plot of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from pipeline.files import atomic
from stages.figures.axes import COLOURS, Series, plot

Point = tuple[float, float, str]  # cost, quality, label

_NAMES = 8  # in a legend of one line
_LABELS = 12  # at most on one front: more hide one another


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Places of the points that no other beats: that costs no more and is no worse, and differs. By cost; equal ones are all there.

    points  (cost, quality)
    """
    order = sorted(range(len(points)), key=lambda place: (points[place][0], -points[place][1]))
    front: list[int] = []
    for place in order:
        if not front or points[place][1] > points[front[-1]][1] or points[place] == points[front[-1]]:
            front.append(place)
    return front


def pareto_plot(path: Path, series: Mapping[str, Sequence[Point]], *, x_label: str, y_label: str) -> None:
    """Write a PNG of points, a line through the front of each series, and labels on the fronts. Where costs differ tenfold, the axis is logarithmic.

    The same points are the same bytes.
    """
    costs = [x for points in series.values() for x, _, _ in points]
    drawn, notes = [], []
    for number, (name, points) in enumerate(series.items()):
        colour = COLOURS[number % len(COLOURS)]
        front = [points[place] for place in pareto_front([(x, y) for x, y, _ in points])]
        drawn.append(Series("", [x for x, _, _ in points], [y for _, y, _ in points], colour, line=False, dots=True))
        drawn.append(Series(name if 1 < len(series) <= _NAMES else "", [x for x, _, _ in front], [y for _, y, _ in front], colour))
        notes += front if len(front) <= _LABELS and len(series) <= 3 else []
    logarithmic = bool(costs) and min(costs) > 0 and max(costs) > 10 * min(costs)
    image = plot((880, 550), drawn, x_label=x_label, y_label=y_label, logarithmic=logarithmic, notes=notes)
    with atomic(path, durable=False) as temporary:
        image.save(temporary, "PNG")
