"""The records of workers, and the circumstances of a result: machine, versions, date."""

import json
import os
import platform
import subprocess
import time
from importlib.metadata import version
from typing import Any, TextIO

from benchmarks.machine import processor
from benchmarks.project import ROOT
from benchmarks.torture.processes import python_alone

LIBRARIES = ("torch", "numpy", "numba", "pycolmap", "av", "OpenEXR", "safetensors", "pillow", "filelock")


def record(book: TextIO, facts: dict[str, Any]) -> None:
    """Add a line to a worker's book at once."""
    book.write(json.dumps(facts) + "\n")
    book.flush()


def circumstances(begun: float, jobs: int, seed: int) -> dict[str, Any]:
    """`begun`: of the monotonic clock."""
    return {
        "operations_seen": "those of Python alone, for want of a C compiler" if python_alone() else "of all libraries (LD_PRELOAD)",
        "elapsed_seconds": round(time.monotonic() - begun, 1),
        "jobs": jobs,
        "seed": seed,
        "date": time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
        "commit": _commit(),
        "machine": {"processor": processor(), "cores": os.cpu_count(), "platform": platform.platform(), "python": platform.python_version()},
        "versions": {name: version(name) for name in LIBRARIES},
    }


def _commit() -> str | None:
    done = subprocess.run(["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"], capture_output=True, text=True)
    return done.stdout.strip() or None
