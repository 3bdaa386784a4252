"""How much memory a run may take: the value of `--memory`, or what the machine and this process's limits allow.

Only `available_now` depends on the memory that other programs take: the same limits give the same plan.

    machine   all of its memory
    cgroup    the smallest limit of the process's control group and of those above it, version 1 or 2
    rlimit    RLIMIT_AS and RLIMIT_DATA, less the addresses that libraries and threads reserve and never use
"""

import contextlib
import ctypes
import gc
import os
import re
import resource
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import UsageError
from pipeline.executors.cores import affinity, cgroup_folders, first_number
from pipeline.text import printable

UNITS = {"": 1, "k": 2**10, "m": 2**20, "g": 2**30, "t": 2**40}
NO_LIMIT = 2**60  # bytes; larger than any real limit; version 1 of control groups states "none" by a number above it
KEPT_BACK = 0.1  # of the machine, or of the control group: for the system, page tables and buffers of files
# Addresses that a process with torch and OpenCV reserves beyond what it uses, and for each thread its stack and the C library's arena.
RESERVED, RESERVED_BY_THREAD = 1200 * 2**20, 72 * 2**20  # under RLIMIT_AS
PRIVATE, PRIVATE_BY_THREAD = 300 * 2**20, 8 * 2**20  # under RLIMIT_DATA, which counts what is writable and private alone


@dataclass(frozen=True)
class Limit:
    """Bytes that this process may take, and whose limit that is: "the machine", "the control group /a/b", "RLIMIT_AS"."""

    bytes: int
    whose: str


def parse_size(text: str) -> int:
    """Bytes in `512m`, `8g`, `1.5GiB`, `2 TB` or `8000000000`; units are powers of 1024. Raises UsageError."""
    found = re.fullmatch(r"(\d{1,20}(?:\.\d{1,9})?)\s*(?:([kmgt])(?:i?b)?|b)?", text.strip().lower(), re.ASCII)
    size = int(float(found[1]) * UNITS[found[2] or ""]) if found else 0
    if not 0 < size <= NO_LIMIT:
        raise UsageError(f"--memory {printable(text[:40])}: expected a size, as in 512m, 8g or 1.5GiB.")
    return size


def limit_for(asked: int | None, recorded: int | None, root: Path = Path("/")) -> Limit | None:
    """A run's limit: the value asked for now, else the smaller of run.json's and this machine's, else this machine's.

    A run.json may be untrusted: it can lower the limit, not raise it.
    """
    here = usable_memory(root)
    if asked is not None:
        return Limit(asked, "--memory")
    if recorded is not None and (here is None or recorded < here.bytes):
        return Limit(recorded, "--memory as run.json has it")
    return here


def size_text(count: float) -> str:
    """Bytes in words: "1.5 GiB", "300 MiB"."""
    return f"{count / 2**30:.1f} GiB" if count >= 2**30 else f"{max(1, round(count / 2**20))} MiB"


def usable_memory(root: Path = Path("/")) -> Limit | None:
    """The smallest limit on this process, less what is kept back; None where the system states none."""
    limits = [Limit(int((1 - KEPT_BACK) * limit.bytes), limit.whose) for limit in (*_machine(root), *_cgroups(root))]
    limits += _rlimits(affinity())
    return min(limits, key=lambda limit: limit.bytes, default=None)


def available_now(root: Path = Path("/")) -> int | None:
    """Bytes that this process could have now: its own and all unused ones; None where the system does not say.

    It changes from moment to moment. Only where data lie may depend on it, and warnings; never what is made, nor what is refused.
    """
    own, free = number_of(root / "proc/self/status", "VmRSS"), number_of(root / "proc/meminfo", "MemAvailable")
    if own is None or free is None:
        return None
    found = own + free
    for folder, _ in cgroup_folders(root, "memory"):
        limit, used = first_number(folder, _LIMITS), first_number(folder, ("memory.current", "memory.usage_in_bytes"))
        if limit is not None and used is not None and limit < NO_LIMIT:
            cached = sum(number_of(folder / "memory.stat", name) or 0 for name in ("inactive_file", "active_file"))
            found = min(found, own + max(0, limit - used + cached))
    return found


def resident() -> int | None:
    """Bytes of this process in memory, what it has freed given back before; None where the system does not say."""
    give_back_freed()
    return number_of(Path("/proc/self/status"), "VmRSS")


def give_back_freed() -> None:
    """Give back to the system what this process has freed: the C library keeps it, and each stage would begin with what those before it took."""
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):  # glibc alone has it
        ctypes.CDLL(None).malloc_trim(0)


_LIMITS = ("memory.max", "memory.limit_in_bytes")  # of version 2, of version 1


def _machine(root: Path) -> Iterator[Limit]:
    total = number_of(root / "proc/meminfo", "MemTotal")
    if total is None and root == Path("/"):  # no Linux
        with contextlib.suppress(AttributeError, OSError, ValueError):
            total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if total:
        yield Limit(total, "the machine")


def _cgroups(root: Path) -> Iterator[Limit]:
    """The limits of the control groups that the process is in, and of those around them, which hold for it too."""
    for folder, name in cgroup_folders(root, "memory"):
        limit = first_number(folder, _LIMITS)
        if limit is not None and limit < NO_LIMIT:
            yield Limit(limit, f"the control group {printable(name)}")


def _rlimits(cores: int) -> list[Limit]:
    """Soft limits on this process's addresses, less what is reserved of them and not used; at least a sixteenth stays."""
    found = []
    for name, reserved, by_thread in (("RLIMIT_AS", RESERVED, RESERVED_BY_THREAD), ("RLIMIT_DATA", PRIVATE, PRIVATE_BY_THREAD)):
        soft, _ = resource.getrlimit(getattr(resource, name))
        if soft != resource.RLIM_INFINITY and 0 <= soft < NO_LIMIT:
            found.append(Limit(max(soft - reserved - cores * by_thread, soft // 16, 1), name))
    return found


def number_of(path: Path, name: str) -> int | None:
    """The number of a line `name 123`; bytes of a line `name: 123 kB`."""
    with contextlib.suppress(OSError, ValueError), path.open(encoding="ascii", errors="replace") as file:
        for line in file:
            words = line.replace(":", " ").split()
            if words[:1] == [name]:
                return int(words[1]) * (1024 if words[2:] == ["kB"] else 1)
    return None
