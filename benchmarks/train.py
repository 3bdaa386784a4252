"""PSNR over training time of several presets on one scene and one machine.

    python benchmarks/train.py SOURCE --runs FOLDER [--presets preview,standard,paper-n4] [--minutes 4] [--slice 20] [--json FILE] [--plot FILE]

The presets take turns of `--slice` seconds, so that other load of the machine affects all of them; each trains for `--minutes` in all, wherever its
schedule ends. Time is that of the training steps alone, wall clock and processor; test views are rendered between the turns and not counted. With
`--whole` the schedule of each preset is as long as fits into the time, as with `enerf run --budget`.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from machine import processor

from stages.figures.plots import with_palette

COLOURS = ("tab:blue", "tab:orange", "tab:green", "tab:red", "tab:purple")


@dataclass
class Contender:
    """A preset in training; points are (wall seconds, processor seconds, steps, PSNR)."""

    name: str
    trainer: Any
    steps: Iterator[Any]
    renderer: Any
    budget: Any
    wall: float = 0.0
    processor: float = 0.0
    points: list[tuple[float, float, int, float]] = field(default_factory=list)
    done: bool = False

    def turn(self, seconds: float) -> None:
        """Train for about so long."""
        began, used = time.perf_counter(), time.process_time()
        while not self.done and time.perf_counter() - began < seconds:
            if next(self.steps, None) is None:
                self.done = True
            elif self.budget is not None and (fixed := self.budget(self.trainer.step, self.wall + time.perf_counter() - began)) is not None:
                self.trainer.schedule = fixed
                self.budget = None
        self.wall += time.perf_counter() - began
        self.processor += time.process_time() - used


def settings_of(preset: str) -> Any:
    from workflows import asset
    from workflows.cli.resolve import Settings, read_preset

    resolved = Settings({stage.name: stage.settings for stage in asset.STAGES})
    resolved.put_table(read_preset(preset).table, preset)
    return resolved.resolved()["train"]


def contender(preset: str, poses: Path, seconds: float, whole: bool) -> Contender:
    from efficientnerf.model import model
    from efficientnerf.rendering.field_renderer import FieldRenderer
    from efficientnerf.training.loop import train, trainer
    from efficientnerf.training.schedule import schedule_of
    from stages.io import scene
    from stages.io.field_file import space_of
    from stages.train.budget import TIMED, UNKNOWN
    from stages.train.data import depth_range, pixels_of, sparse_depth_of
    from stages.train.hash_resolution import with_auto_sizes

    s, settings = scene.load(poses), settings_of(preset)
    views = scene.views_of(s, "train")
    pixels = pixels_of(poses, views)
    settings = with_auto_sizes(settings, s, len(pixels))
    near, far = depth_range(s, pixels, settings)
    m = model(space_of(s), settings, s.background, "cpu", (near, far))
    hold = settings.occupancy_warmup_steps + TIMED
    schedule = dataclasses.replace(schedule_of(settings), iterations=UNKNOWN, hold=hold) if whole else schedule_of(settings)
    t = trainer(m, schedule=schedule)
    warmed: list[tuple[int, float]] = []

    def plan(step: int, wall: float) -> Any:
        """As `stages.train.budget` does, by the time of this contender alone."""
        if not warmed and step >= settings.occupancy_warmup_steps:
            warmed.append((step, wall))
        if step < hold:
            return None
        each = (wall - warmed[0][1]) / (step - warmed[0][0])
        return dataclasses.replace(schedule, iterations=step + max(1, int((seconds - wall) / each)))

    return Contender(preset, t, iter(train(t, pixels, sparse_depth_of(poses, s))), FieldRenderer(m, near, far), plan if whole else None)


def test_views(poses: Path, count: int, side: int) -> list[tuple[Any, Any, int]]:
    """Cameras, their images, and by how much both are subsampled."""
    from stages.evaluate.views import ground_truth, subsample, subsample_camera
    from stages.io import scene

    s = scene.load(poses)
    views = scene.views_of(s, "test") or scene.views_of(s, "val")
    out = []
    for view in views[:: max(1, len(views) // count)][:count]:
        stride = -(-max(view.camera.width, view.camera.height) // side)
        out.append((subsample_camera(view.camera, stride), subsample(ground_truth(poses, view, s.background).colour, stride), stride))
    return out


def measure(each: Contender, views: list[tuple[Any, Any, int]]) -> float:
    import numpy as np

    from efficientnerf.evaluation.metrics import psnr

    found = [psnr(np.clip(each.renderer.render(camera).colour, 0, 1), truth) for camera, truth, _ in views]
    each.points.append((each.wall, each.processor, each.trainer.step, float(np.mean(found))))
    return each.points[-1][3]


def plot(report: dict[str, Any], path: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4.5), dpi=100, layout="tight")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for (name, row), colour in zip(report["presets"].items(), COLOURS, strict=False):
        axes.plot([p[0] for p in row["points"]], [p[3] for p in row["points"]], label=f"{name}, {row['steps']} steps", color=colour, marker=".")
    axes.set(xlabel="seconds of training", ylabel="PSNR over test views / dB")
    axes.set_title(f"{report['source']}, {report['processor']}, {report['threads']} threads")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    canvas.print_png(path, metadata={"Software": None})
    with_palette(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    parser.add_argument("--runs", type=Path, required=True, help="folder of the run with the cameras; made if it is not there")
    parser.add_argument("--presets", default="preview,standard,paper-n4")
    parser.add_argument("--minutes", type=float, default=4.0, help="of training, for each preset")
    parser.add_argument("--slice", type=float, default=20.0, help="seconds of a turn")
    parser.add_argument("--whole", action="store_true", help="fit each schedule into the time")
    parser.add_argument("--views", type=int, default=4, help="test views that are rendered")
    parser.add_argument("--side", type=int, default=200, help="their longest side, pixels at most")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plot", type=Path)
    arguments = parser.parse_args()
    run = arguments.runs / arguments.source.name
    command = [sys.executable, "-m", "workflows.cli.main", "run", str(arguments.source), "--out", str(run), "--until", "poses", "--quiet"]
    subprocess.run(command, check=True)
    from stages.cores import use_all_cores

    use_all_cores()
    poses, seconds, load = run / "poses", 60 * arguments.minutes, os.getloadavg()
    views = test_views(poses, arguments.views, arguments.side)
    field_of = [contender(preset, poses, seconds, arguments.whole) for preset in arguments.presets.split(",")]
    for each in field_of:
        each.turn(0.0)
    while any(not each.done and each.wall < seconds for each in field_of):
        for each in field_of:
            if not each.done and each.wall < seconds:
                each.turn(min(arguments.slice, seconds - each.wall))
                found = measure(each, views)
                print(f"{each.name:12} {each.wall:7.1f} s  {each.processor:7.1f} s cpu  step {each.trainer.step:6}  {found:6.2f} dB", flush=True)
    report = {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "source": arguments.source.name, "processor": processor(), "threads": int(os.environ.get("OMP_NUM_THREADS", 0)) or len(os.sched_getaffinity(0)),
        "load_before": load, "load_after": os.getloadavg(), "views": len(views), "strides": sorted({stride for *_, stride in views}),
        "whole_schedule": arguments.whole, "python": platform.python_version(), "versions": {name: version(name) for name in ("torch", "numba", "numpy")},
        "points_are": ["wall seconds", "processor seconds", "steps", "PSNR"],
        "presets": {each.name: {"steps": each.trainer.step, "points": each.points} for each in field_of},
    }  # fmt: skip
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    if arguments.plot:
        plot(report, arguments.plot)


if __name__ == "__main__":
    main()
