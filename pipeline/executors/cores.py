"""How many cores this process may use, and the number of threads of libraries that do not look at all of its limits; and the control groups of Linux, by
which containers and batch systems limit processes."""

import contextlib
import os
from collections.abc import Iterator, MutableMapping
from pathlib import Path, PurePosixPath

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


def cgroup_folders(root: Path, controller: str) -> Iterator[tuple[Path, str]]:
    """(folder, name) of each control group of this process by which the controller (memory, cpu) limits it, the innermost first.

    A line of /proc/self/cgroup is `number:controllers:/path`. In version 2 (number 0, no controllers) all are mounted at one place, /sys/fs/cgroup, or
    `unified` in it together with version 1; in version 1 those of a controller at its name, or at those of all that are mounted with it. Within a container the
    path may be that of the host, and the container's own group the root of the mount; so the root is always among them.

    root  where /proc and /sys lie, for tests
    """
    try:
        lines = (root / "proc/self/cgroup").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = ["0::/"]
    for line in lines:
        number, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        if controller in controllers.split(","):
            mounts = list(dict.fromkeys([f"sys/fs/cgroup/{controller}", f"sys/fs/cgroup/{controllers}"]))
        elif number == "0" and not controllers:
            mounts = ["sys/fs/cgroup", "sys/fs/cgroup/unified"]
        else:
            continue
        inner = PurePosixPath("/", path)
        if ".." in inner.parts:  # the group of another namespace
            inner = PurePosixPath("/")
        for name in (inner, *inner.parents):
            for mount in mounts:
                yield root / mount / name.relative_to("/"), str(name)


def first_number(folder: Path, names: tuple[str, ...]) -> int | None:
    """The number in the first file that holds one; "max" is none."""
    for name in names:
        with contextlib.suppress(OSError, ValueError):
            return int((folder / name).read_text(encoding="ascii", errors="replace")[:32])
    return None
