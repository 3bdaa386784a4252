"""Arms a run at one of its file operations: it is ended or signalled there, or the operation fails, once or from then on.

With a C compiler a library that is loaded before all others (trap.c) sees the operations of every library: SQLite, FFmpeg, OpenEXR, safetensors, COLMAP.
Without one, `audit` sees those of Python alone. Kinds of operations:

    read, open    a file is opened for reading, for writing
    write         also writev, pwrite, fwrite, ftruncate, sendfile, copy_file_range
    fsync         also fdatasync
    rename, mkdir, unlink, rmdir
"""

import mmap
import os
import shutil
import struct
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

KINDS = ("read", "open", "write", "fsync", "rename", "mkdir", "unlink", "rmdir")
CHANGING = KINDS[1:]  # the operations of a disk that is full or may not be written
NAMES = ("STATE", "LOG", "RUN", "SOURCE", "STAGE", "ACTION", "KINDS", "FAULT_KINDS", "NUMBER", "ERRNO", "LASTING", "DEADLY")  # in the environment, after TRAP_
_STATE = struct.Struct("qqq2048s")


def build(folder: Path) -> Path | None:
    """The library of trap.c; None where there is no C compiler."""
    compiler = next((found for name in ("cc", "gcc", "clang") if (found := shutil.which(name))), None)
    library = folder / "trap.so"
    if compiler is None or library.exists():
        return library if library.exists() else None
    source = Path(__file__).with_name("trap.c")
    done = subprocess.run([compiler, "-shared", "-fPIC", "-O2", "-o", library, source, "-ldl"], capture_output=True, text=True)
    return library if done.returncode == 0 else None


def mask(kinds: Sequence[str]) -> int:
    return sum(1 << KINDS.index(kind) for kind in kinds)


@dataclass(frozen=True)
class Trap:
    """What happens at which operation.

    number    of the operation, from 1, among those of `kinds` of `stage`; 0: operations are only counted and logged
    stage     the name of a stage, "source", "engine" (all else in the run) or "" for any
    action    "leader:15" sends a signal to the process that was started, "group:9" to its children too; "" none
    errno     the operation fails with it; 0: it is carried out
    lasting   so do all those of `fault_kinds` after it, of any stage
    deadly    the failing operation at which all of the run is killed; 0: none
    """

    number: int = 0
    stage: str = ""
    kinds: Sequence[str] = KINDS
    action: str = ""
    errno: int = 0
    lasting: bool = False
    fault_kinds: Sequence[str] = CHANGING
    deadly: int = 0


@dataclass
class Armed:
    """A trap in a run's environment, and what became of it."""

    trap: Trap
    run: Path
    source: Path
    state: Path
    log: Path | None = None
    environment: dict[str, str] = field(init=False)

    def __post_init__(self) -> None:
        self.state.write_bytes(bytes(mmap.PAGESIZE))
        trap = self.trap
        values = [self.state, self.log or "", self.run, self.source, trap.stage, trap.action, mask(trap.kinds), mask(trap.fault_kinds), trap.number, trap.errno]
        self.environment = {f"TRAP_{name}": str(value) for name, value in zip(NAMES, [*values, int(trap.lasting), trap.deadly], strict=True)}

    def _read(self) -> tuple[int, int, bytes]:
        _seen, fired, failed, path = _STATE.unpack(self.state.read_bytes()[: _STATE.size])
        return fired, failed, path

    def disarm(self) -> None:
        """No operation is the one that is meant from now on."""
        with open(self.state, "r+b") as file:
            file.write(struct.pack("q", 2**40))

    @property
    def fired(self) -> bool:
        return bool(self._read()[0])

    @property
    def failed(self) -> int:
        """Operations that were let fail."""
        return self._read()[1]

    @property
    def place(self) -> tuple[str, str, str]:
        """Stage, kind and path of the operation that was hit; empty before."""
        stage, kind, path = [*os.fsdecode(self._read()[2].split(b"\0")[0]).split("\t", 2), "", "", ""][:3]
        return stage, kind, path


@dataclass(frozen=True)
class Operation:
    """Of an undisturbed run.

    stage   as in `Trap`
    number  among the operations of its kind of its stage, from 1
    """

    stage: str
    kind: str
    number: int
    path: str


def operations(log: Path) -> list[Operation]:
    """What a run did, in order."""
    counts: dict[tuple[str, str], int] = {}
    found = []
    for line in log.read_text(encoding="utf-8", errors="surrogateescape").splitlines():
        stage, kind, path = line.split("\t", 2)
        counts[stage, kind] = number = counts.get((stage, kind), 0) + 1
        found.append(Operation(stage, kind, number, path))
    return found
