"""What a fleet says while it runs: a line for each stage that ends and whatever goes wrong, JSON lines, or nothing but what goes wrong."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipeline.fleet.state import FleetState
from pipeline.text import printable
from workflows.cli.output import write_json
from workflows.cli.progress import duration

_BAD = ("scene_failed", "scene_quarantined", "retry", "warning")


class Show:
    """Takes the scheduler's events, and the state whenever it was written."""

    def __init__(self, fleet: Path, *, as_json: bool, quiet: bool) -> None:
        self.fleet, self.as_json, self.quiet = fleet, as_json, quiet

    def __call__(self, event: dict[str, Any]) -> None:
        if self.as_json:
            if not (self.quiet and event["event"] == "progress"):
                write_json(event)
        elif (line := sentence(event)) is not None and (not self.quiet or event["event"] in _BAD):
            print(line, file=sys.stderr, flush=True)

    def written(self, state: FleetState) -> None:
        """fleet.json was written: so are the pages made of it."""


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
            return f"{scene}: {printable(event['text'], 1000)}"
    return None


@contextmanager
def display(fleet: Path, *, as_json: bool, quiet: bool) -> Iterator[Show]:
    """The display for the options."""
    yield Show(fleet, as_json=as_json, quiet=quiet)
    if as_json:
        sys.stdout.flush()
