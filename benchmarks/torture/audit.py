"""What trap.c does, for the operations of Python alone: those of libraries go unseen.

Opening, renaming, making and removing are seen by an audit hook; writing and syncing by functions that take the place of Python's.
"""

import builtins
import io
import mmap
import os
import signal
import struct
import sys
import threading
from collections.abc import Callable
from typing import Any

from benchmarks.torture.trap import KINDS

_COUNTERS = struct.Struct("qqq")
_EVENTS = {"os.rename": "rename", "os.mkdir": "mkdir", "os.remove": "unlink", "os.rmdir": "rmdir"}
_inside = threading.local()


class Watch:
    """The trap of the environment, in this process."""

    def __init__(self) -> None:
        of = {name: os.environ.get(f"TRAP_{name}", "") for name in ("LOG", "RUN", "SOURCE", "STAGE", "ACTION")}
        self.log, self.run, self.source, self.stage, self.action = of.values()
        self.kinds, self.fault_kinds = int(os.environ["TRAP_KINDS"]), int(os.environ["TRAP_FAULT_KINDS"])
        self.number, self.errno, self.lasting, self.deadly = (int(os.environ[f"TRAP_{name}"]) for name in ("NUMBER", "ERRNO", "LASTING", "DEADLY"))
        with open(os.environ["TRAP_STATE"], "r+b") as file:
            self.state = mmap.mmap(file.fileno(), mmap.PAGESIZE)

    def meet(self, kind: str, path: str) -> None:
        """Before each operation; raises the OSError that it fails with."""
        in_run = path == self.run or path.startswith(self.run + "/")
        if not in_run and not (kind == "read" and path.startswith(self.source + "/")):
            return
        stage = self._stage(path) if in_run else "source"
        if self.log:
            descriptor = os.open(self.log, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
            _write(descriptor, os.fsencode(f"{stage}\t{kind}\t{path}\n"))
            os.close(descriptor)
        seen, fired, failed = _COUNTERS.unpack_from(self.state)
        bit = 1 << KINDS.index(kind)
        counted = bool(bit & self.kinds) and self.stage in ("", stage)
        seen += counted
        fails = False
        if self.number and counted and seen == self.number:
            fired, fails = 1, self.errno != 0
            text = os.fsencode(f"{stage}\t{kind}\t{path}")[:2047]
            self.state[_COUNTERS.size : _COUNTERS.size + len(text)] = text
        elif self.lasting and fired and bit & self.fault_kinds:
            fails = True
        _COUNTERS.pack_into(self.state, 0, seen, fired, failed + fails)
        if self.number and counted and seen == self.number and self.action:
            whom, _, number = self.action.partition(":")
            (os.killpg if whom == "group" else os.kill)(os.getpgrp(), int(number))
        if fails and failed + 1 == self.deadly:
            os.killpg(os.getpgrp(), signal.SIGKILL)
        if fails:
            raise OSError(self.errno, os.strerror(self.errno), path)

    def _stage(self, path: str) -> str:
        name = path[len(self.run) + 1 :].removeprefix(".work/").removeprefix("old-").partition("/")[0]
        return "engine" if not name or "." in name or "-" in name else name


def _absolute(path: Any, folder: int | None = None) -> str:
    if isinstance(path, int):
        return os.readlink(f"/proc/self/fd/{path}")
    text = os.fsdecode(path)
    if folder is not None and folder >= 0 and not os.path.isabs(text):
        return os.path.join(os.readlink(f"/proc/self/fd/{folder}"), text)
    return os.path.abspath(text)


_write, _fsync, _open = os.write, os.fsync, io.open


def arm() -> None:
    """Arm this process by its environment; there is no way back."""
    watch = Watch()

    def meet(kind: str, path: Any, folder: int | None = None) -> None:
        if getattr(_inside, "busy", False):
            return
        _inside.busy = True
        try:
            try:
                where = _absolute(path, folder)
            except (OSError, TypeError, ValueError):
                return
            watch.meet(kind, where)
        finally:
            _inside.busy = False

    def heard(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open" and not isinstance(arguments[0], int) and arguments[0] is not None:
            flags = arguments[2] or 0
            if not flags & os.O_DIRECTORY:
                meet("read" if flags & os.O_ACCMODE == os.O_RDONLY else "open", arguments[0])
        elif event in _EVENTS:
            meet(_EVENTS[event], arguments[0], arguments[-1] if event != "os.rename" else arguments[2])

    class Raw(io.FileIO):
        def write(self, data: Any) -> int:
            meet("write", self.fileno())
            return super().write(data)

    def opened(file: Any, mode: str = "r", buffering: int = -1, encoding: Any = None, errors: Any = None, newline: Any = None, *more: Any, **named: Any) -> Any:
        if not set(mode) & set("wxa") or "+" in mode or buffering == 0 or more or named:
            return _open(file, mode, buffering, encoding, errors, newline, *more, **named)
        raw = io.BufferedWriter(Raw(file, mode.replace("b", "").replace("t", "")))
        return raw if "b" in mode else io.TextIOWrapper(raw, encoding or "utf-8", errors, newline)

    def met_first(kind: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(descriptor: int, *arguments: Any) -> Any:
            meet(kind, descriptor)
            return function(descriptor, *arguments)

        return call

    sys.addaudithook(heard)
    os.write, os.fsync = met_first("write", _write), met_first("fsync", _fsync)  # type: ignore[assignment]
    builtins.open = io.open = opened  # type: ignore[assignment]
