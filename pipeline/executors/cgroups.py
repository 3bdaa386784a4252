"""Control groups of Linux, by which containers and batch systems limit processes."""

import contextlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath


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
