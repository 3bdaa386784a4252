"""A stage that says when it waits for kernels to be compiled."""

from __future__ import annotations

import functools
from collections.abc import Callable

from pipeline.stage import Job


def compiling_kernels(run: Callable[[Job], None]) -> Callable[[Job], None]:
    """A stage's `run` that tells the user when the first kernel is compiled rather than loaded, and in the end how long that took."""

    @functools.wraps(run)
    def telling(job: Job) -> None:
        from efficientnerf.backends.kernel_cache import compilation

        with compilation(lambda: job.say("compiling kernels, once")) as found:
            run(job)
        if found.functions:
            job.say(f"compiling kernels, once: {found.seconds:.0f} s", compile_seconds=found.seconds)

    return telling
