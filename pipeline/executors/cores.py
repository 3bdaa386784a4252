"""How many cores this process may use, and the number of threads of libraries that do not look at all of its limits."""

import contextlib
import os
from collections.abc import MutableMapping
from pathlib import Path

from pipeline.executors.cgroups import cgroup_folders, first_number

# Each is read when its library is loaded: OpenMP (torch), numba, OpenBLAS (NumPy) and OpenCV.
VARIABLES = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")


def affinity() -> int:
    """CPUs that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def cores(root: Path = Path("/")) -> int:
    """Those, or as many as the quotas of the control groups allow where that is fewer, rounded up."""
    found = affinity()
    for folder, _ in cgroup_folders(root, "cpu"):
        quota, period = _quota(folder)
        if quota > 0 and period > 0:
            found = min(found, max(1, -(-quota // period)))
    return found


def keep_to_quota(environment: MutableMapping[str, str] | None = None, root: Path = Path("/")) -> None:
    """Where a quota allows fewer cores than the process may run on, let libraries start no more threads, unless the user says how many.

    They count the processors: more threads than the quota has cores are stopped together, for most of each period.
    """
    environment = os.environ if environment is None else environment
    found = cores(root)
    if found < affinity():
        number = environment.get(VARIABLES[0], str(found)).partition(",")[0]  # OpenMP's may be a list of levels
        for name in VARIABLES:
            environment.setdefault(name, number)


def _quota(folder: Path) -> tuple[int, int]:
    """(microseconds of processor time in a period, microseconds of that); (0, 0) where there is none: cpu.max of version 2, cpu.cfs_* of version 1."""
    with contextlib.suppress(OSError, ValueError):
        quota, period = (folder / "cpu.max").read_text(encoding="ascii", errors="replace")[:64].split()
        return int(quota), int(period)  # "max" is none
    return first_number(folder, ("cpu.cfs_quota_us",)) or 0, first_number(folder, ("cpu.cfs_period_us",)) or 0
