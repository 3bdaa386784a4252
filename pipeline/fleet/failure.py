"""Decides about a scene whose stage failed: try again, try differently, or give up with the reason.

its process crashed                           once more, on another worker if there is one
its worker died                               the same, and then failed: stages run in child processes, so the scene is hardly the cause
nothing more is heard of it                   again: the scheduler of Dask has gone
memory ran out                                once more, in half of the memory; where that is too little to begin with, alone on the largest worker
it needs more memory than it was given        once more, in what it needs, if a worker has that
its run is locked                             again, until the lock is given back or the lease expires
the disk is full, its run stayed locked       failed: by circumstances; the fleet's command tries it again
anything else, or the same once more          quarantined: by itself; only `retry` tries it again
"""

import signal
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from pipeline.executors.memory import size_text
from pipeline.text import printable

LOCKED_SECONDS = 600.0  # that a run may stay locked by another process; a lease has expired long before
LOCKED_PAUSE = 2.0
HEADROOM = 1.05  # of what a stage takes, by itself or by an estimate: buffers of files and pipes
_LEAST = 64 * 2**20  # bytes; less memory is no memory
_MOST_ENLARGED = 3  # times that a stage may find that it needs more than it has: as it begins, and once it has counted what it will make


@dataclass
class Attempts:
    """Failures so far of the stage that a scene is at."""

    crashes: int = 0
    out_of_memory: int = 0
    enlarged: int = 0
    locked_since: float | None = None
    lost_on: tuple[str, ...] = ()  # the workers on which it was lost
    memory: int | None = None  # bytes that it is to run in, where they are not those of its estimate or the worker's share
    alone: bool = False  # whether it had a worker for itself after memory ran out

    @property
    def count(self) -> int:
        return self.crashes + self.out_of_memory + self.enlarged


@dataclass(frozen=True)
class Remedy:
    """What to do now: "again", "later", or set the scene's state; with a reason, a sentence."""

    action: Literal["again", "later", "failed", "quarantined"]
    reason: str


def remedy(what: str, result: Mapping[str, Any], attempts: Attempts, *, worker: str, given: int | None, largest: int | None, now: float) -> Remedy:
    """Judge the result of a failed task, and count it in `attempts`.

    what     the stage, for the reason
    given    bytes that it might take; None: no limit was known
    largest  bytes of the largest worker; None: no limit is known
    now      seconds, of any clock
    """
    kind, text = result.get("kind"), printable(result.get("text") or "no reason was given.", 1500)
    ended_for_memory = kind == "died" and result.get("signal") == signal.SIGKILL
    if kind == "lost" or (kind in ("died", "stopped") and not ended_for_memory):
        return _crashed(what, text, attempts, worker, "failed" if kind == "lost" else "quarantined")
    if kind == "memory" or ended_for_memory:
        return _out_of_memory(what, text, attempts, given)
    if kind == "refused":
        return _refused(what, text, int(result.get("needed") or 0), attempts, given, largest)
    if kind == "unheard":
        return Remedy("later", text)
    if kind == "locked":
        attempts.locked_since = now if attempts.locked_since is None else attempts.locked_since
        return Remedy("later" if now - attempts.locked_since < LOCKED_SECONDS else "failed", text)
    return Remedy("failed" if kind == "disk" else "quarantined", text)


def _crashed(what: str, text: str, attempts: Attempts, worker: str, then: Literal["failed", "quarantined"]) -> Remedy:
    attempts.crashes += 1
    attempts.lost_on = (*attempts.lost_on, worker)
    if attempts.crashes == 1:
        return Remedy("again", f"{what}: {text} It is tried once more.")
    return Remedy(then, f"{what}: {text} It was tried on {' and '.join(dict.fromkeys(attempts.lost_on))}.")


def _out_of_memory(what: str, text: str, attempts: Attempts, given: int | None) -> Remedy:
    attempts.out_of_memory += 1
    shown = "" if given is None else f" in {size_text(given)}"
    if attempts.out_of_memory == 1 and (given is None or given >= 2 * _LEAST):
        attempts.memory = None if given is None else given // 2
        return Remedy("again", f"{what}: memory ran out{shown} ({text.rstrip('.')}). It is tried once more{'' if given is None else ', in half of that'}.")
    return Remedy("quarantined", f"{what}: memory ran out{' again' if attempts.out_of_memory > 1 else ''}{shown} ({text.rstrip('.')}).")


def _refused(what: str, text: str, needed: int, attempts: Attempts, given: int | None, largest: int | None) -> Remedy:
    fits = needed > (given or 0) and (largest is None or needed <= largest)
    if attempts.out_of_memory and not attempts.alone and fits and largest is not None:
        attempts.alone, attempts.memory = True, largest
        return Remedy("again", f"{what}: memory ran out, and with less it does not begin. It is tried once more, alone on a worker.")
    if attempts.out_of_memory or not fits or attempts.enlarged == _MOST_ENLARGED:
        before = "memory ran out, and with less it does not begin: " if attempts.out_of_memory else ""
        return Remedy("quarantined", before + text)
    attempts.enlarged += 1
    asked = int(HEADROOM * needed)
    attempts.memory = asked if largest is None else min(asked, largest)
    return Remedy("again", text)
