"""Displays of a run: bars on a terminal, lines in a log, one JSON object per event, or nothing but warnings.

Each display is a callable that takes the engine's events. Text goes to standard error; standard output is for results.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any, TextIO

from pipeline.text import printable
from workflows.cli.output import write_json

Event = Mapping[str, Any]

SECONDS_BETWEEN_LINES = 10.0  # of a stage, in a log

# Numbers beyond these come of files that are damaged, or made to mislead.
_LONGEST = 1e12  # seconds
_LARGEST = 2**64  # bytes


def duration(seconds: float) -> str:
    """`8.1 s`, `2 min 05 s`, `1 h 02 min`; `?` for what is no time."""
    if not 0 <= seconds < _LONGEST:
        return "?"
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def size(count: float) -> str:
    """Bytes in decimal units: `812 B`, `3.4 MB`; `?` for what is no size."""
    if not 0 <= count < _LARGEST:
        return "?"
    for unit in ("B", "kB", "MB", "GB"):
        if count < 999.5:
            return f"{count:.0f} {unit}" if unit == "B" or count >= 99.95 else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"


def facts(event: Event) -> str:
    """Facts of an event besides its text, as `loss 0.0123, psnr 24.1`."""
    known = {"event", "stage", "time", "done", "total", "text", "left"}
    shown = [f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}" for name, value in event.items() if name not in known]
    return ", ".join(shown)


def sentence(event: Event) -> str:
    """An event in words, without its stage; empty for those that are not shown."""
    match event["event"]:
        case "stage_started":
            reason = event.get("reason")
            return f"started ({reason})" if reason else "started"
        case "stage_done":
            seconds, cores = event.get("seconds"), event.get("cores")
            return "done" if seconds is None else f"done in {duration(seconds)}" + (f", {event['cores_busy']:.1f} of {cores} cores busy" if cores else "")
        case "stage_skipped":
            return "up to date"
        case "message":
            return str(event.get("text", ""))
        case "warning":
            return f"warning: {event.get('text', '')}"
        case _:
            # stage_failed and interrupted end the run: the error that follows says it all.
            return ""


def warning(text: str) -> Event:
    """The event that shows a warning."""
    return {"event": "warning", "stage": "", "text": text, "time": time.time()}


def _line(stage: str, words: str) -> str:
    """An event as one line; names of files in it may hold anything."""
    return printable(f"{stage:<9} {words}" if stage else words)


class Lines:
    """Plain lines, for logs and pipes."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self.stream = stream or sys.stderr
        self.last: dict[str, float] = {}  # of each stage the time of its last line

    def __call__(self, event: Event) -> None:
        stage = event.get("stage") or ""
        if event["event"] == "stage_started":
            self.last[stage] = time.monotonic()
        if event["event"] == "progress":
            self._progress(stage, event)
        elif words := sentence(event):
            self._line(stage, words)

    def _line(self, stage: str, words: str) -> None:
        print(_line(stage, words), file=self.stream, flush=True)

    def _progress(self, stage: str, event: Event) -> None:
        now, total = time.monotonic(), event.get("total") or 0
        if now - self.last.get(stage, -SECONDS_BETWEEN_LINES) < SECONDS_BETWEEN_LINES:
            return
        self.last[stage] = now
        share = event.get("done", 0) / total if total else 0.0
        left = f"{duration(event['left'])} left" if event.get("left") else ""
        words = [f"{share:4.0%}" if total else "", str(event.get("text", "")), facts(event), left]
        self._line(stage, "  ".join(word for word in words if word))


class Bars:
    """A bar with the remaining time of each running stage, on a terminal."""

    def __init__(self) -> None:
        from rich.console import Console  # a log needs none
        from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn  # likewise

        self.console = Console(stderr=True, highlight=False)
        self.progress = Progress(
            TextColumn("{task.fields[stage]:<9}"),
            BarColumn(bar_width=24),
            TextColumn("{task.percentage:>3.0f}%"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.description}"),
            console=self.console,
            transient=True,
        )
        self.tasks: dict[str, tuple[TaskID, float | None]] = {}  # of each stage its bar, and the total of the part that it shows

    def __enter__(self) -> Bars:
        self.progress.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.progress.stop()

    def __call__(self, event: Event) -> None:
        stage = event.get("stage") or ""
        if event["event"] == "progress":
            self._advance(stage, event)
            return
        if event["event"] in ("stage_done", "stage_failed", "interrupted"):
            self._clear(stage)
        if words := sentence(event):
            style = "yellow" if event["event"] == "warning" else None
            self.console.print(_line(stage, words), style=style, markup=False, soft_wrap=True)

    def _clear(self, stage: str) -> None:
        if stage in self.tasks:
            self.progress.remove_task(self.tasks.pop(stage)[0])

    def _advance(self, stage: str, event: Event) -> None:
        total, text = event.get("total") or None, str(event.get("text", ""))
        # A bar of its own for each part of a stage, so that the time left is that of the part.
        if stage not in self.tasks or self.tasks[stage][1] != total:
            self._clear(stage)
            self.tasks[stage] = self.progress.add_task(text, total=total, stage=stage), total
        words = "  ".join(word for word in (text, facts(event)) if word)
        self.progress.update(self.tasks[stage][0], completed=event.get("done", 0), description=printable(words).replace("[", "\\["))


def json_line(event: Event, *, quiet: bool = False) -> None:
    """One JSON object per event on standard output; `quiet`: but for progress."""
    if not (quiet and event["event"] == "progress"):
        write_json(event)


def warnings_only(event: Event) -> None:
    if event["event"] == "warning":
        print(_line(event.get("stage") or "", sentence(event)), file=sys.stderr, flush=True)


@contextmanager
def display(*, as_json: bool, quiet: bool) -> Iterator[Callable[[Event], None]]:
    """The display for the options and the kind of output."""
    if as_json:
        yield partial(json_line, quiet=quiet)
    elif quiet:
        yield warnings_only
    elif sys.stderr.isatty():
        with Bars() as bars:
            yield bars
    else:
        yield Lines()
