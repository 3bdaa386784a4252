"""From an exception of a stage to the error that is shown to the user."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

from pipeline.disk import disk_full, is_disk_full
from pipeline.errors import Interrupted, PipelineError, StageFailed

_FULL_TEXTS = ("no space left on device", "disk quota exceeded", "disk is full", "disk full")  # of libraries that drop the number of the error
_NOTHING_FREE = 2**16  # bytes


def history(error: BaseException) -> Iterator[BaseException]:
    """The error, what it was raised from, what was being handled then, and so on."""
    visited: set[int] = set()
    pending: list[BaseException | None] = [error]
    while pending:
        current = pending.pop()
        if current is None or id(current) in visited:
            continue
        visited.add(id(current))
        yield current
        pending += [current.__context__, current.__cause__]


def interruption_in(error: BaseException, signalled: int | None) -> Interrupted | None:
    """The interruption that a foreign library may have wrapped into an error of its own, on the way through a callback."""
    for cause in history(error):
        if isinstance(cause, Interrupted):
            return cause
        if isinstance(cause, KeyboardInterrupt):
            return Interrupted() if signalled is None else Interrupted(signalled)
    return None


def translated(error: BaseException, stage: str, run: Path) -> PipelineError:
    """A PipelineError stays as it is; a full disk, a lack of memory and everything else become one line about the stage."""
    full = _full_folder(error, run)
    if full is not None:
        return disk_full(full, stage)
    if isinstance(error, PipelineError):
        return error
    if any(isinstance(cause, MemoryError) for cause in history(error)):
        return StageFailed(f"{stage}: out of memory. Close other programs, or use a smaller preset or smaller images.")
    first = next((line.strip() for line in str(error).splitlines() if line.strip()), "")
    text = f"{type(error).__name__}: {first}" if first else type(error).__name__
    return StageFailed(f"{stage}: {text[:500]}")


def _full_folder(error: BaseException, run: Path) -> Path | None:
    """The folder whose disk is full, if that is what happened."""
    for cause in history(error):
        if is_disk_full(cause):
            name = getattr(cause, "filename", None)
            return Path(name).absolute().parent if isinstance(name, str) else run
        if any(text in str(cause).lower() for text in _FULL_TEXTS):
            return run
    if not isinstance(error, PipelineError) and shutil.disk_usage(run).free < _NOTHING_FREE:
        return run  # a library that gave no reason
    return None
