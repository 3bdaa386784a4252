"""FLEET/comparison.html: the scenes of a sweep by the settings that it changed, with PSNR over seconds and over MB.

Seconds are those that a scene takes by itself: a stage that another scene made for it counts as if it had made it.
"""

from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any
from urllib.parse import quote

from pipeline.files import write_atomically
from pipeline.fleet.state import FleetState, SceneState
from pipeline.text import printable
from stages.figures.pareto import pareto_front, pareto_plot
from workflows.cli.progress import duration
from workflows.fleet.pages.index import filled, quality_of, value_text
from workflows.fleet.sweeps import unswept
from workflows.report.page import NAME as REPORT

NAME = "comparison.html"
FOLDER = "comparison"
PLOTS = {
    f"{FOLDER}/psnr_over_seconds.png": ("seconds", "time of all stages / s", "PSNR over the time of all stages; the line: best at their time"),
    f"{FOLDER}/psnr_over_megabytes.png": ("megabytes", "asset / MB", "PSNR over the size of the asset; the line: best at their size"),
}
FIGURES: dict[str, Callable[[float], str]] = {  # of a Result, and how they are shown
    "psnr": "{:.2f}".format, "ssim": "{:.3f}".format, "seconds": duration, "megabytes": "{:.2f}".format,
}  # fmt: skip
_TABLES = 200  # scenes with a table of their own


@dataclass(frozen=True)
class Result:
    """A scene with one combination of values, or the means of all scenes with it. Without figures: not done yet, or not measured."""

    scene: str  # its name without the values; "" for means
    values: tuple[Any, ...]  # of the settings that the sweep changed
    psnr: float | None = None
    ssim: float | None = None
    seconds: float | None = None
    megabytes: float | None = None
    state: str = ""
    run: str | None = None  # whose report is linked


def write_comparison(fleet: Path, state: FleetState, reports: Container[str] = (), *, plots: bool = True) -> bool:
    """Write the page, and the plots anew if `plots`; returns whether the fleet is a sweep. `reports`: scenes whose report is linked. Raises OSError."""
    settings = settings_of(state)
    if not settings:
        return False
    found = results(state, settings, reports)
    means = mean_results(found)
    if plots:
        (fleet / FOLDER).mkdir(exist_ok=True)
        for name, (cost, label, _) in PLOTS.items():
            pareto_plot(fleet / name, _series(found, means, settings, cost), x_label=label, y_label="PSNR / dB")
    there = [(name, caption) for name, (_, _, caption) in PLOTS.items() if (fleet / name).is_file()]
    write_atomically(fleet / NAME, _page(fleet.absolute().name, settings, found, means, there).encode("utf-8"), durable=plots)
    return True


def settings_of(state: FleetState) -> list[str]:
    """The settings that the sweep changed, as "stage.setting", in its order."""
    return list(dict.fromkeys(setting for scene in state.scenes for setting in scene.sweep or {}))


def results(state: FleetState, settings: Sequence[str], reports: Container[str] = ()) -> list[Result]:
    """One for each scene of the sweep."""
    known = {scene.name: scene for scene in state.scenes}
    return [_result(scene, known, settings, reports) for scene in state.scenes if scene.sweep]


def _result(scene: SceneState, known: dict[str, SceneState], settings: Sequence[str], reports: Container[str]) -> Result:
    name, values = unswept(scene.name, scene.sweep or {}), tuple((scene.sweep or {}).get(setting) for setting in settings)
    if scene.state != "done":
        return Result(name, values, state=scene.state)
    seconds = 0.0
    for stage, found in scene.stages.items():
        donor = known.get(scene.shares.get(stage, ""))
        seconds += donor.stages[stage].seconds if donor is not None and stage in donor.stages else found.seconds
    quality = quality_of(scene)
    run = scene.run if scene.name in reports else None
    return Result(name, values, quality["psnr"], quality["ssim"], seconds, scene.bytes / 1e6 if scene.bytes else None, scene.state, run)


def mean_results(found: Sequence[Result]) -> list[Result]:
    """Means over the scenes of which every combination is measured; none where that are fewer than two."""
    scenes: dict[str, dict[str, Result]] = {}
    for each in found:
        scenes.setdefault(each.scene, {})[repr(each.values)] = each
    combinations = list(dict.fromkeys(repr(each.values) for each in found))
    whole = [of for of in scenes.values() if all(values in of and of[values].psnr is not None for values in combinations)]
    if len(whole) < 2:
        return []
    return [_mean([of[values] for of in whole]) for values in combinations]


def _mean(found: Sequence[Result]) -> Result:
    def mean(name: str) -> float | None:
        values = [getattr(each, name) for each in found]
        return fmean(values) if all(value is not None for value in values) else None

    return Result("", found[0].values, mean("psnr"), mean("ssim"), mean("seconds"), mean("megabytes"), f"{len(found)} scenes")


def _series(found: Sequence[Result], means: Sequence[Result], settings: Sequence[str], cost: str) -> dict[str, list[tuple[float, float, str]]]:
    """Of each scene, or the means where there are too many scenes for one plot."""
    series: dict[str, list[tuple[float, float, str]]] = {}
    names = dict.fromkeys(each.scene for each in found)
    for each in means if means and len(names) > 6 else found:
        if each.psnr is not None and getattr(each, cost) is not None:
            label = ", ".join(f"{setting.partition('.')[2]} {value_text(value)}" for setting, value in zip(settings, each.values, strict=True))
            series.setdefault(each.scene or "mean", []).append((getattr(each, cost), each.psnr, label[:60]))
    return series


def best(found: Sequence[Result], cost: str) -> set[int]:
    """Places of those that no other beats in PSNR and in this cost."""
    measured = [place for place, each in enumerate(found) if each.psnr is not None and getattr(each, cost) is not None]
    return {measured[place] for place in pareto_front([(getattr(found[place], cost), found[place].psnr or 0.0) for place in measured])}


def _page(title: str, settings: Sequence[str], found: Sequence[Result], means: Sequence[Result], plots: Sequence[tuple[str, str]]) -> str:
    names = list(dict.fromkeys(each.scene for each in found))
    tables = [_table(f"Means over {means[0].state}", means)] if means else []
    tables += [_table(name, [each for each in found if each.scene == name]) for name in names[:_TABLES]]
    done = sum(each.state == "done" for each in found)
    note = f"{done} of {len(found)} runs are done." + (f" The first {_TABLES} scenes have tables here; fleet.csv has all." if len(names) > _TABLES else "")
    return filled("comparison.html.j2", title=title, settings=[printable(each, 200) for each in settings], note=note, tables=tables, plots=plots)


def _table(title: str, rows: Sequence[Result]) -> dict[str, Any]:
    at_time, at_size = best(rows, "seconds"), best(rows, "megabytes")
    return {"title": title, "rows": [_row(each, place in at_time, place in at_size) for place, each in enumerate(rows)]}


def _row(each: Result, at_time: bool, at_size: bool) -> dict[str, Any]:
    figures = ["" if (value := getattr(each, name)) is None else shown(value) for name, shown in FIGURES.items()]
    link = None if each.run is None else f"{quote(each.run)}/{REPORT}"
    values = [value_text(value) for value in each.values]
    return {"settings": values, "figures": figures, "best_at_time": at_time, "best_at_size": at_size, "link": link, "state": each.state}
