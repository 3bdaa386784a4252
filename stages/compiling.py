"""Stages that run kernels: they report when these are compiled, which no time budget counts."""

import functools
import time
from collections.abc import Callable

import torch

from efficientnerf.backends.kernel_cache import Compilation, compilation
from pipeline.stage import Job

_compilations: list[Compilation] = []  # of the stages that ran in this process


def running_kernels(run: Callable[[Job], None]) -> Callable[[Job], None]:
    """A stage's `run` that tells the user when the first kernel is compiled rather than loaded, and in the end how long that took.

    Meanwhile denormal numbers are zero, for good in threads that it starts. Densities and gradients of empty space are so small, and an Intel Xeon took more
    than twice as long for a training step with them. docs/experiments/first-minutes.md
    """

    @functools.wraps(run)
    def reporting(job: Job) -> None:
        torch.set_flush_denormal(True)
        try:
            with compilation(lambda: job.say("compiling kernels, once")) as found:
                _compilations.append(found)
                run(job)
        finally:
            torch.set_flush_denormal(False)
        if found.functions:
            job.say(f"compiling kernels, once: {found.seconds:.0f} s", compile_seconds=found.seconds)

    return reporting


def clock() -> float:
    """Seconds, monotonic, of a clock that stands still while a stage waits for kernels to be compiled."""
    return time.monotonic() - sum(each.seconds for each in _compilations)
