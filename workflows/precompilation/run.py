"""The process that `start` begins: it takes the made scene through all stages, so that their kernels are compiled."""

import contextlib
import json
import os
import shutil
import tempfile
import threading
from pathlib import Path
from typing import Any

import filelock

from pipeline.errors import PipelineError
from pipeline.run import Run
from pipeline.runner import run_stages
from workflows.asset import WORKFLOW
from workflows.precompilation.scene import write_scene
from workflows.precompilation.start import REQUEST, stamp_of

NICE = 10  # where there is no SCHED_IDLE


def precompile(settings: dict[str, dict[str, Any]], folder: Path) -> None:
    """Compile the kernels of all stages of a run with these settings. The folder is empty."""
    write_scene(folder / "source")
    run = Run.create(folder / "run", folder / "source", settings, device="cpu")
    run_stages(run, WORKFLOW.stages, device="cpu")
    stamp_of(settings).touch()


def give_way() -> None:
    """Run when a core has nothing else to do: threads of the run that wake many times a second then never wait for this process, as they do for one that is
    only nice. docs/experiments/first-minutes.md"""
    with contextlib.suppress(OSError, AttributeError):  # of systems that have none, and of sandboxes
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
        return
    with contextlib.suppress(OSError, AttributeError):
        os.nice(NICE)


def _end_with_parent(folder: Path) -> None:
    """End this process when the one that began it has gone, or has closed its end of the pipe."""
    with contextlib.suppress(OSError):
        while os.read(0, 1):
            pass
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(0)  # whatever is being compiled: a form is kept whole or not at all


def main() -> None:
    request = json.loads(os.environ[REQUEST])
    give_way()
    with tempfile.TemporaryDirectory(prefix="efficientnerf-", ignore_cleanup_errors=True) as name:
        if not request["detached"]:
            threading.Thread(target=_end_with_parent, args=(Path(name),), daemon=True).start()
        # Another such process is enough for all runs that begin now; and what is missing in the end a run itself compiles.
        lock = filelock.FileLock(stamp_of(request["settings"]).with_name("lock"), timeout=0)
        with contextlib.suppress(filelock.Timeout, PipelineError), lock:
            precompile(request["settings"], Path(name))


if __name__ == "__main__":
    main()
