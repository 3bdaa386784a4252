"""Requests of `enerf fleet retry` and `cancel` to the process that runs the fleet, on any machine: files in FLEET/.requests, taken in order."""

import contextlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from pipeline import files
from pipeline.fleet.state import MOST_SCENES

FOLDER = ".requests"
MAX_AT_ONCE = 100  # that are taken at a time
ANSWER_SECONDS = 30.0  # that the caller waits for the process that runs the fleet, which checks every second
_LIMIT = 4 * 2**20  # bytes of one


@dataclass(frozen=True)
class Request:
    """scenes: their names; None: all."""

    do: Literal["cancel", "retry"]
    scenes: Annotated[list[Annotated[str, msgspec.Meta(max_length=200)]], msgspec.Meta(max_length=MOST_SCENES)] | None = None


def ask(fleet: Path, do: Literal["cancel", "retry"], scenes: Sequence[str] | None) -> Path:
    """Leave a request for the process that runs the fleet, in the file that is returned: gone once it is taken. Raises OSError."""
    folder = fleet / FOLDER
    folder.mkdir(exist_ok=True)
    value = {"do": do, "scenes": None if scenes is None else list(scenes)}
    path = folder / f"{time.time_ns():020d}.json"
    files.write_json(path, value)
    return path


def outcome(path: Path, is_running: Callable[[], bool]) -> Literal["taken", "ended", "left"]:
    """What becomes of a request: taken; ended: the fleet did first, and it is withdrawn; or left: no answer within ANSWER_SECONDS."""
    deadline = time.monotonic() + ANSWER_SECONDS
    look = time.monotonic() + 2.0
    while files.exists(path):
        now = time.monotonic()
        if now >= look:
            look = now + 2.0
            if not is_running():
                try:
                    path.unlink()
                except FileNotFoundError:
                    break  # it was taken at last
                return "ended"
        if now >= deadline:
            return "left"
        time.sleep(0.1)
    return "taken"


def take(fleet: Path) -> list[Request]:
    """Requests that have come, the oldest first; they are removed. One that cannot be read is removed unheeded."""
    folder, found = fleet / FOLDER, []
    if not files.is_folder(folder):
        return []
    for path in sorted(folder.glob("[0-9]*.json"))[:MAX_AT_ONCE]:
        with contextlib.suppress(OSError, ValueError):  # of msgspec, too
            found.append(msgspec.convert(files.read_json(path, limit=_LIMIT, follow=False), Request))
        with contextlib.suppress(OSError):
            path.unlink()
    return found


def left(fleet: Path) -> list[str]:
    """Take the requests to a process that has ended: the scenes to try again. Cancellations no longer matter."""
    names: list[str] = []
    while found := take(fleet):
        names += [name for request in found if request.do == "retry" for name in request.scenes or ()]
    return names
