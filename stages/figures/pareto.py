"""Quality over cost: which choices no other beats in both, and a plot of them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pipeline.files import atomic
from stages.figures.drawing import new_figure

Point = tuple[float, float, str]  # cost, quality, label

_MARKS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*")
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
    figure, canvas = new_figure(8.0, 5.0, 110)
    axes = figure.add_subplot()
    costs = [x for points in series.values() for x, _, _ in points]
    logarithmic = bool(costs) and min(costs) > 0 and max(costs) > 10 * min(costs)
    for number, (name, points) in enumerate(series.items()):
        colour = f"C{number % 10}"
        axes.scatter([x for x, _, _ in points], [y for _, y, _ in points], color=colour, alpha=0.55, marker=_MARKS[number // 10 % len(_MARKS)], s=30)
        front = [points[place] for place in pareto_front([(x, y) for x, y, _ in points])]
        axes.plot([x for x, _, _ in front], [y for _, y, _ in front], color=colour, label=name, linewidth=1.4)
        for x, y, label in front if len(front) <= _LABELS and len(series) <= 3 else []:
            # A label to the right of a point there would leave the axes; it stands above, for the line rises.
            right = x * x > min(costs) * max(costs) if logarithmic else 2 * x > min(costs) + max(costs)
            place: dict[str, Any] = {"xytext": (-5, 7) if right else (5, -11), "horizontalalignment": "right" if right else "left"}
            axes.annotate(label, (x, y), textcoords="offset points", fontsize=7.5, color="0.25", parse_math=False, **place)
    if logarithmic:
        axes.set_xscale("log")
    axes.margins(x=0.12, y=0.1)
    axes.set(xlabel=x_label, ylabel=y_label)
    axes.grid(alpha=0.3)
    if 1 < len(series) <= 20:
        axes.legend(frameon=False, fontsize=8)
    with atomic(path, durable=False) as temporary:
        canvas.print_png(temporary, metadata={"Software": None})  # without the program's version, for the same bytes
