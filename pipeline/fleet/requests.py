"""What `enerf fleet retry` and `cancel` ask of the process that runs the fleet, on whatever machine that is: files in FLEET/.requests, taken in order."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from pipeline import files
from pipeline.fleet.state import MOST_SCENES

FOLDER = ".requests"
MOST = 100  # that are taken at a time
_LIMIT = 4 * 2**20  # bytes of one


@dataclass(frozen=True)
class Request:
    """scenes: their names; None: all."""

    do: Literal["cancel", "retry"]
    scenes: Annotated[list[Annotated[str, msgspec.Meta(max_length=200)]], msgspec.Meta(max_length=MOST_SCENES)] | None = None


def ask(fleet: Path, do: Literal["cancel", "retry"], scenes: Sequence[str] | None) -> None:
    """Leave a request for the process that runs the fleet. Raises OSError."""
    folder = fleet / FOLDER
    folder.mkdir(exist_ok=True)
    value = {"do": do, "scenes": None if scenes is None else list(scenes)}
    files.write_json(folder / f"{time.time_ns():020d}.json", value)


def take(fleet: Path) -> list[Request]:
    """Requests that have come, the oldest first; they are removed. One that cannot be read is removed unheeded."""
    folder, found = fleet / FOLDER, []
    if not files.is_folder(folder):
        return []
    for path in sorted(folder.glob("[0-9]*.json"))[:MOST]:
        with contextlib.suppress(OSError, ValueError):  # of msgspec, too
            found.append(msgspec.convert(files.read_json(path, limit=_LIMIT, follow=False), Request))
        with contextlib.suppress(OSError):
            path.unlink()
    return found


def clear(fleet: Path) -> None:
    """Remove requests to a process that has ended without taking them."""
    while take(fleet):
        pass
