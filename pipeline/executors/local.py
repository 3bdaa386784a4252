"""Runs a stage in this process.

An executor is a function (Stage, Job) -> Usage. It returns when job.out is complete and lets what the stage raises pass; all the rest
(requests, publishing, locks, signals) is the runner's. One that sends stages elsewhere needs only the paths in the job and its two callables.
"""

from __future__ import annotations

import contextlib
import sys
import time
from dataclasses import dataclass

from pipeline.stage import Job, Stage


@dataclass(frozen=True)
class Usage:
    """What a stage cost: wall clock in seconds, peak resident memory of the process in bytes."""

    seconds: float
    peak_memory: int


def execute(stage: Stage, job: Job) -> Usage:
    """Run the stage to its end."""
    _reset_peak()
    started = time.monotonic()
    stage.run(job)
    return Usage(time.monotonic() - started, peak_memory())


def _reset_peak() -> None:
    """Linux can forget the peak of the stages before; elsewhere the peak is that of the whole process."""
    with contextlib.suppress(OSError), open("/proc/self/clear_refs", "w") as file:
        file.write("5")


def peak_memory() -> int:
    """Bytes; 0 where the system does not say."""
    with contextlib.suppress(OSError, ValueError), open("/proc/self/status", encoding="ascii", errors="replace") as file:
        for line in file:
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    with contextlib.suppress(ImportError):
        import resource  # not on Windows

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024
    return 0
