"""Runs a stage in this process.

An executor is a function (Stage, Job) -> Usage. It returns when job.out is complete; errors of the stage pass through. The runner does the rest
(requests, publishing, locks, signals). An executor that sends stages elsewhere needs only the job's paths and its two callables.
"""

import contextlib
import gc
import os
import resource
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from pipeline.executors.cores import cores
from pipeline.executors.memory import give_back_freed, number_of
from pipeline.stage import Job, Stage


@dataclass(frozen=True)
class Usage:
    """What a stage cost."""

    seconds: float  # wall clock
    peak_memory: int  # resident memory of the process, bytes; or of a child that has ended meanwhile, if it took more
    cpu_seconds: float = 0.0  # processor time of the process and of its children that have ended; 0 where it is not known
    cores: int = 0  # that the process may use; 0 where it is not known


def execute(stage: Stage, job: Job) -> Usage:
    """Run the stage to its end."""
    give_back_freed()
    _reset_peak()
    started, busy, child = time.monotonic(), cpu_seconds(), peak_memory_of_children()
    stage.run(job)
    grown = peak_memory_of_children()  # of all children so far: known to be of this stage's only where it has grown
    return Usage(time.monotonic() - started, max(peak_memory(), grown if grown > child else 0), cpu_seconds() - busy, cores())


def execute_alone(stage: Stage, job: Job) -> Usage:
    """`execute` in a process that runs stages alone: the garbage collector scans what they leave (libraries, compiled kernels) only once.

    Otherwise each scan takes up to a second, when a stage begins and during it. Garbage is freed before; the rest stays until the process ends.
    """
    give_back_freed()
    gc.freeze()
    return execute(stage, job)


def cpu_seconds() -> float:
    """User and system time of this process and of its children that have ended."""
    return sum(os.times()[:4])


def _reset_peak() -> None:
    """Linux can forget the peak of the stages before; elsewhere the peak is that of the process so far."""
    with contextlib.suppress(OSError), open("/proc/self/clear_refs", "w") as file:
        file.write("5")


def peak_memory() -> int:
    """Bytes."""
    return number_of(Path("/proc/self/status"), "VmHWM") or _bytes(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)


def peak_memory_of_children() -> int:
    """Bytes of the largest child that has ended."""
    return _bytes(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)


def _bytes(resident: int) -> int:
    return resident if sys.platform == "darwin" else resident * 1024
