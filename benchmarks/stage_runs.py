"""Commands, with the time and memory that they take."""

import json
import os
import subprocess
import time
from pathlib import Path
from typing import Any


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
