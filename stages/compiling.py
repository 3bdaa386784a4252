"""Stages that report when kernels are compiled; no time budget counts that."""

import functools
import time
from collections.abc import Callable

from efficientnerf.backends.kernel_cache import Compilation, compilation
from pipeline.stage import Job

_compilations: list[Compilation] = []  # of the stages that ran in this process


def compiling_kernels(run: Callable[[Job], None]) -> Callable[[Job], None]:
    """A stage's `run` that tells the user when the first kernel is compiled rather than loaded, and in the end how long that took."""

    @functools.wraps(run)
    def reporting(job: Job) -> None:
        with compilation(lambda: job.say("compiling kernels, once")) as found:
            _compilations.append(found)
            run(job)
        if found.functions:
            job.say(f"compiling kernels, once: {found.seconds:.0f} s", compile_seconds=found.seconds)

    return reporting


def clock() -> float:
    """Seconds, monotonic, of a clock that stands still while a stage waits for kernels to be compiled."""
    return time.monotonic() - sum(each.seconds for each in _compilations)
