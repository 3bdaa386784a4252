"""The progress of a run: the states of its stages, the curves of their logs, and the previews, of finished stages and of what is being made."""

import os
import re
import stat
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec

from pipeline.artifact import workplace
from pipeline.decide import Decision, survey
from pipeline.errors import PipelineError
from pipeline.hashes import Hashes
from pipeline.run import Run
from pipeline.stage import Stage
from pipeline.text import printable
from stages.artifacts import BakeOutputs, TrainOutputs
from stages.scratch import opened
from workflows.cli.target import open_run
from workflows.inspection.status import run_status
from workflows.report.signature import VIEWER, viewers

TRAINED = (TrainOutputs, BakeOutputs)  # the stages that have a log and previews
PREVIEW = re.compile(r"preview_([0-9]{6,12})\.png")
MOST_PREVIEWS, MOST_POINTS = 100, 300
LARGEST_LOG = 2**25  # bytes
PAUSE = 1.0  # seconds at least between two readings of a run,
SHARE = 0.1  # of which reading takes at most this share, however many requests come
_Number = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]


class _Line(msgspec.Struct):
    """The shown part of a log line."""

    step: Annotated[int, msgspec.Meta(ge=0, le=2**53)]
    seconds: _Number | None = None
    psnr: _Number | None = None
    preview_psnr: _Number | None = None


class Progress:
    """A run that others write, read now and then."""

    def __init__(self, path: Path, stages: Sequence[Stage]) -> None:
        self.path, self.stages = path, stages
        self.previews: dict[tuple[str, str], str] = {}  # stage and name -> file, relative to the run: all that may be asked for
        self._lock = threading.Lock()
        self._hashes = Hashes(Run(path).cache)
        self._state: dict[str, Any] = {}
        self._due = -float("inf")

    def state(self) -> dict[str, Any]:
        """As `enerf status --json` gives, with `training`: steps, curves and previews by stage; `asset`: an identifier of what the viewer shows, or None;
        `error`: why the run could not be read now, or None. Where it is too early to read again, the last state is returned."""
        with self._lock:
            began = time.monotonic()
            if began >= self._due:
                try:
                    self._state = {**self._look(), "error": None}
                except (PipelineError, OSError) as error:  # a stage may be replaced under our eyes
                    self._state = {**self._state, "error": printable(error, 500)}
                now = time.monotonic()
                self._due = now + max(PAUSE, (now - began) / SHARE)
            return self._state

    def _look(self) -> dict[str, Any]:
        run = open_run(self.path)
        decisions = survey(self.stages, run, hashes=self._hashes)
        previews: dict[tuple[str, str], str] = {}
        training = {outputs.stage: _training(run, each, previews) for outputs in TRAINED for each in decisions if each.stage == outputs.stage}
        self.previews = previews
        return {**run_status(run, decisions), "name": run.path.name, "training": training, "asset": shown_identity(run)}


def shown_identity(run: Run) -> str | None:
    """An identifier of what a run's viewer shows, Gaussians or the asset, which changes when it is replaced; None: no asset."""
    try:
        status = os.lstat(viewers(run).get(VIEWER, BakeOutputs.of_run(run.path).asset))
    except OSError:
        return None
    return f"{status.st_ino}-{status.st_size}-{status.st_mtime_ns}" if stat.S_ISREG(status.st_mode) else None


def _training(run: Run, decision: Decision, previews: dict[tuple[str, str], str]) -> dict[str, Any]:
    """The curve and the previews of a stage: of what is being made where there is any, else of what it made."""
    folder = run.folder(decision.stage)
    images = folder / TrainOutputs.previews  # the same name in both
    making = None if decision.fresh or decision.request is None else workplace(run.path, decision.stage, decision.request).scratch
    if making is not None and making.is_dir():
        folder = images = making
    names = _preview_names(images)
    for name in names:
        previews[decision.stage, name] = (images / name).relative_to(run.path).as_posix()
    lines = _lines(folder / TrainOutputs.log)
    last = lines[-1] if lines else None
    return {
        "live": folder == making,
        "step": None if last is None else last.step,
        "seconds": None if last is None else last.seconds,
        "psnr": _points([(line.step, line.psnr) for line in lines if line.psnr is not None]),
        "preview_psnr": _points([(line.step, line.preview_psnr) for line in lines if line.preview_psnr is not None]),
        "previews": names,
    }


def _preview_names(folder: Path) -> list[str]:
    """The names of previews in a folder, by step; of many the first and the last ones."""
    try:
        names = sorted((name for name in os.listdir(folder) if PREVIEW.fullmatch(name)), key=lambda name: int(name[8:-4]))
    except OSError:
        return []
    return names if len(names) <= MOST_PREVIEWS else [names[0], *names[1 - MOST_PREVIEWS :]]


def _lines(path: Path) -> list[_Line]:
    """A log's lines up to one that is none; none where there is no log yet."""
    found: list[_Line] = []
    try:
        with opened(path) as file:
            data = file.read(LARGEST_LOG)
        for text in data.splitlines():
            found.append(msgspec.json.decode(text, type=_Line))
    except (OSError, ValueError, RecursionError, msgspec.MsgspecError):
        pass  # cut short by a kill, or being written
    return found


def _points(points: list[tuple[int, float]]) -> list[tuple[int, float]]:
    """At most so many of them, evenly spaced, the last one among them; rounded."""
    count = len(points)
    if count > MOST_POINTS:
        points = [points[(k * (count - 1)) // (MOST_POINTS - 1)] for k in range(MOST_POINTS)]
    return [(step, round(value, 3)) for step, value in points]
