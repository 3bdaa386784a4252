"""Copies of runs whose later stages are run again with other settings; time and memory of each."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

LATER = ("bake", "mesh", "splats", "evaluate", "turntable", "points")
OWN = (".lock", ".lease", ".work", ".cache")  # a lock belongs to the file, not to its name


def linked_copy(run: Path, copy: Path) -> Path:
    """Make `copy` a run of its own with the poses and training of `run`: hard links where the file system has them."""

    def link(source: str, target: str) -> str:
        try:
            os.link(source, target)
        except OSError:
            shutil.copy2(source, target)
        return target

    if not (run / "train").is_dir():
        raise SystemExit(f"{run}: holds no trained field (train/). Run: enerf run SOURCE --out {run} --until train")
    shutil.copytree(run, copy, copy_function=link, ignore=lambda folder, names: [n for n in names if Path(folder) == run and n in (*LATER, *OWN)])
    settings = copy / "run.json"  # is written again with other settings, so not a link
    text = settings.read_bytes()
    settings.unlink()
    settings.write_bytes(text)
    return copy


def made(run: Path, stage: str, settings: dict[str, Any]) -> dict[str, float]:
    """Run a stage again: `seconds` by the clock, `cpu_seconds` of all threads and `peak_mib` of resident memory, of the whole command."""
    command = [sys.executable, "-m", "workflows.cli.main", "stage", stage, str(run), "--force", "--quiet"]
    for name, value in settings.items():
        command += ["--set", f"{name}={value}"]
    return cost_of(command)


def cost_of(command: list[str]) -> dict[str, float]:
    """Run a command: `seconds` by the clock, `cpu_seconds` of all its threads and `peak_mib` of resident memory."""
    start = time.perf_counter()
    child = subprocess.Popen(command)
    _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode != 0:
        raise SystemExit(f"{' '.join(command)}: exit code {child.returncode}")
    return {"seconds": time.perf_counter() - start, "cpu_seconds": used.ru_utime + used.ru_stime, "peak_mib": used.ru_maxrss / 1024}


def read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))
