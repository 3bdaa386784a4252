"""Displays of a running fleet: a line for each stage that ends, on a terminal above what runs; JSON lines; or only what goes wrong."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipeline.fleet.state import FleetState
from pipeline.text import printable
from workflows.cli.output import write_json
from workflows.cli.progress import duration, json_line
from workflows.fleet.pages.updates import Pages
from workflows.fleet.table import LiveTable

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
