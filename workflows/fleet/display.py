"""Displays of a running fleet: a line for each stage that ends, on a terminal above what runs; JSON lines; or only what goes wrong."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from pipeline.fleet.state import FleetState, Totals
from pipeline.text import printable
from workflows.cli.output import write_json
from workflows.cli.progress import duration, json_line
from workflows.fleet.pages.updates import Pages

BAR = 10  # characters
BAD_GRADES = ("poor", "failed")  # of a result, that a fleet points out
_BELOW_AND_ABOVE = 5  # lines of the terminal that rows do not take
_BAD = ("scene_failed", "scene_quarantined", "retry", "warning")


class Show:
    """Takes the scheduler's events, and the state whenever it was written: pages are made of it.

    table  what runs; None where there is no terminal
    """

    def __init__(self, fleet: Path, *, as_json: bool, quiet: bool, table: LiveTable | None = None) -> None:
        self.as_json, self.quiet, self.table = as_json, quiet, table
        self._pages = Pages(fleet)
        self._trouble: str | None = None

    def __call__(self, event: dict[str, Any]) -> None:
        self._pages.catch_up()
        if self.as_json:
            json_line(event, quiet=self.quiet)
            return
        line, bad = sentence(event), event["event"] in _BAD
        if self.table is not None:
            self.table(event)
        if line is not None and (bad or not self.quiet):
            self._say(line, "yellow" if bad else None)

    def written(self, state: FleetState) -> None:
        """fleet.json was written."""
        if self.table is not None:
            self.table.state = state
        self._pages(state)
        if self._pages.trouble is not None and self._pages.trouble != self._trouble:
            text = f"the fleet's pages cannot be written: {self._pages.trouble}"
            if self.as_json:
                write_json({"event": "warning", "scene": "", "text": text})
            else:
                self._say(text, "yellow")
        self._trouble = self._pages.trouble

    def _say(self, line: str, style: str | None) -> None:
        if self.table is not None:
            self.table.say(line, style)
        else:
            print(printable(line), file=sys.stderr, flush=True)


def sentence(event: dict[str, Any]) -> str | None:
    """An event as a line; None for what is no news."""
    scene, stage = printable(event["scene"], 100), printable(event.get("stage") or "", 40)
    match event["event"]:
        case "stage_done":
            return f"{scene}: {stage} done in {duration(event['seconds'])}"
        case "scene_done":
            return f"{scene}: done"
        case "scene_failed" | "scene_quarantined":
            return f"{scene}: {event['event'].removeprefix('scene_')}: {printable(event['text'], 1000)}"
        case "retry" | "warning":
            return f"{scene}: {printable(event['text'], 1000)}" if scene else printable(event["text"], 1000)
    return None


@contextmanager
def display(fleet: Path, *, as_json: bool, quiet: bool) -> Iterator[Show]:
    """The display for the options and the kind of output."""
    if as_json or quiet or not sys.stderr.isatty():
        yield Show(fleet, as_json=as_json, quiet=quiet)
        sys.stdout.flush()
        return

    with LiveTable() as table:
        yield Show(fleet, as_json=as_json, quiet=quiet, table=table)


class LiveTable:
    """Takes the scheduler's events, and the state whenever it was written. While it is open, messages are printed above it."""

    def __init__(self) -> None:
        self.console = Console(stderr=True, highlight=False)
        self.state = FleetState()
        self._progress: dict[str, tuple[float, str]] = {}  # scene -> the share that is done, and of what
        self._live = Live(console=self.console, get_renderable=self.table, refresh_per_second=4, transient=True)

    def __enter__(self) -> LiveTable:
        self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._live.stop()

    def __call__(self, event: dict[str, Any]) -> None:
        """An event of a scene: how far its stage is."""
        scene = str(event.get("scene", ""))
        self._progress.pop(scene, None)
        if event["event"] == "progress" and event.get("total"):
            self._progress[scene] = min(1.0, max(0.0, event["done"] / event["total"])), printable(event.get("text") or "", 60)

    def say(self, line: str, style: str | None) -> None:
        """A line above the table."""
        self.console.print(printable(line), style=style, markup=False, soft_wrap=True)

    def table(self) -> Table:
        """As many rows as fit on the terminal."""
        made = Table(expand=True, box=None, pad_edge=False, show_header=False, caption=Text(overview(self.state)), caption_justify="left")
        for ratio in (None, None, None, 1):
            made.add_column(ratio=ratio, no_wrap=True, overflow="ellipsis")
        running = [scene for scene in self.state.scenes if scene.state == "running"]
        rows = max(3, self.console.height - _BELOW_AND_ABOVE)
        for scene in running[:rows]:
            share, text = self._progress.get(scene.name, (None, ""))
            filled = round(BAR * (share or 0.0))
            bar = "" if share is None else f"{'━' * filled}{'╌' * (BAR - filled)} {share:4.0%}"
            made.add_row(*map(Text, (printable(scene.name, 60), printable(scene.stage or "", 20), bar, text)))
        if len(running) > rows:
            made.add_row(Text(f"and {len(running) - rows} more"))
        return made


def overview(state: FleetState) -> str:
    """A line: scenes by state, how many of their results are poor or failed, and the forecast."""
    totals = Totals.of(state.scenes)
    counts = ((word, getattr(totals, word)) for word in ("done", "running", "waiting", "failed", "quarantined"))
    parts = [f"{count} {word}" for word, count in counts if count]
    grades = [scene.result.grade for scene in state.scenes if scene.result is not None]
    parts += [f"{grades.count(grade)} with a {grade} result" for grade in BAD_GRADES if grade in grades]
    ahead = "" if not state.forecast_seconds else f"; about {duration(state.forecast_seconds)} to go"
    return (", ".join(parts) or "no scenes") + ahead + (f"; {printable(state.note, 300)}" if state.note else "")
