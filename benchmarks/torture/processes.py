"""Runs of `enerf` as processes of their own, each with a session and a process group.

Most are forked from a process that has imported everything and loaded the compiled kernels, so that a run begins at once; the others are the real
command in a fresh process. Nothing here starts a thread: a fork of a process with threads may hang.
"""

import contextlib
import ctypes
import faulthandler
import gc
import importlib
import json
import os
import pkgutil
import select
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.project import PACKAGES, ROOT
from benchmarks.torture.trap import Armed

FRESH = ("-m", "workflows.cli.main")
FRESH_WATCHED = ("-c", "import sys; from benchmarks.torture.audit import arm; arm(); from workflows.cli.main import main; sys.exit(main())")
LIMIT = 300.0  # seconds for a run
LEFT_OUT = ("triton", "__main__", "pycolmap")  # in names of modules: no device here; structure from motion has threads of its own


def python_alone() -> bool:
    """Whether the library of trap.c is not loaded into this process: then only the operations of Python are seen, by `audit`."""
    return not hasattr(ctypes.CDLL(None), "trap_arm")


def single_threaded_environment(library: Path | None) -> dict[str, str]:
    """For the process that forks, and so for all runs: one thread each, as runs go on side by side, and the library that counts operations."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS")
    path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, **dict.fromkeys(names, "1"), "PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
    if library is not None:
        environment["LD_PRELOAD"] = str(library)
    return environment


@dataclass
class Child:
    """A run that was started with --json, and its events so far."""

    pid: int
    reading: int
    errors_file: Path
    armed: Armed | None
    fresh: bool
    began: float = field(default_factory=time.monotonic)
    events: list[dict[str, Any]] = field(default_factory=list)
    started: dict[str, float] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    stage: str = ""
    code: int | None = None
    _rest: bytes = b""
    _closed: bool = False

    def listen(self, timeout: float = 0.0) -> None:
        """Read the events that it has printed, waiting so many seconds for more."""
        if self._closed:
            if timeout:
                time.sleep(min(timeout, 0.002))
            return
        while select.select([self.reading], [], [], timeout)[0]:
            timeout = 0.0
            data = os.read(self.reading, 65536)
            if not data:
                self._closed = True
                return
            *lines, self._rest = (self._rest + data).split(b"\n")
            for line in lines:
                with contextlib.suppress(ValueError):
                    self._note(json.loads(line))

    def _note(self, event: dict[str, Any]) -> None:
        now, stage, kind = time.monotonic(), event.get("stage", ""), event.get("event", "")
        self.events.append(event)
        if kind == "stage_started":
            self.started[stage], self.stage = now, stage
        elif kind == "stage_done":
            self.seconds[stage] = now - self.started.get(stage, now)
            self.stage = ""

    def alive(self) -> bool:
        """What takes longer than LIMIT is killed: exit code -9, and `hung` in its errors, behind what its threads were at."""
        if self.code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if not pid and time.monotonic() - self.began > LIMIT:
                self._abort()
            elif pid:
                self.code = os.waitstatus_to_exitcode(status)
        return self.code is None

    def _abort(self) -> None:
        self.signal(signal.SIGCONT, group=True)
        self.signal(signal.SIGABRT)  # `faulthandler` prints the stacks
        time.sleep(1.0)
        self.signal(signal.SIGKILL, group=True)
        with open(self.errors_file, "a", encoding="utf-8") as file:
            file.write(f"hung: not done after {LIMIT:g} s\n")
        os.waitpid(self.pid, 0)
        self.code = -signal.SIGKILL

    def signal(self, number: int, *, group: bool = False) -> None:
        if self.code is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.pid, number) if group else os.kill(self.pid, number)

    def end(self) -> int:
        """Wait for the end; the exit code, negative for a signal."""
        while self.alive():
            self.listen(0.02)
        while not self._closed and select.select([self.reading], [], [], 0)[0]:
            self.listen()
        os.close(self.reading)
        assert self.code is not None
        return self.code

    @property
    def errors(self) -> str:
        return self.errors_file.read_text(encoding="utf-8", errors="replace")

    @property
    def resumed(self) -> bool:
        return any(event.get("event") == "stage_started" and event.get("resumed") for event in self.events)

    def leftover(self, patience: float = 5.0) -> bool:
        """Whether a process of its group lives on for so many seconds."""
        until = time.monotonic() + patience
        while _group_lives(self.pid):
            if time.monotonic() > until:
                return True
            time.sleep(0.01)
        return False


def _group_lives(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    for entry in os.scandir("/proc") if os.path.isdir("/proc/self") else ():  # one that nobody has waited for yet is no more than a name
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                fields = Path(entry.path, "stat").read_text().rpartition(")")[2].split()
                if int(fields[2]) == group and fields[0] not in "ZX":
                    return True
    return False


def start(
    arguments: Sequence[str],
    errors_file: Path,
    armed: Armed | None = None,
    *,
    fresh: bool = False,
    user: int | None = None,
    workflow: Any = None,
) -> Child:
    """Begin `enerf` with these arguments.

    fresh     as the real command, in a new process
    user      the number of the user to be, for a process of root
    workflow  of a forked run's command line; that of `workflows.asset` by default
    """
    reading, writing = os.pipe()

    def child() -> int:
        try:
            os.setsid()
            _redirect(writing, errors_file)
            os.close(reading)
            if armed is not None:
                os.environ.update(armed.environment)
            if user is not None:
                os.setgid(user)
                os.setuid(user)
            if fresh:
                program = FRESH_WATCHED if armed is not None and python_alone() else FRESH
                os.execv(sys.executable, [sys.executable, *program, *arguments])
            return _run(arguments, armed, workflow)
        except KeyboardInterrupt:  # as Python itself ends
            signal.signal(signal.SIGINT, signal.SIG_DFL)
            os.kill(os.getpid(), signal.SIGINT)
            return 1

    pid = forked(child)
    os.close(writing)
    return Child(pid, reading, errors_file, armed, fresh)


def _redirect(writing: int, errors_file: Path) -> None:
    nothing = os.open(os.devnull, os.O_RDONLY)
    errors = os.open(errors_file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    for source, target in ((nothing, 0), (writing, 1), (errors, 2)):
        os.dup2(source, target)
        os.close(source)


def _run(arguments: Sequence[str], armed: Armed | None, workflow: Any) -> int:
    """In the forked child."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    sys.argv = ["enerf", *arguments]
    # Whatever the parent made of its own: pytest, for one, puts others in their place.
    sys.stdout, sys.stderr = (open(descriptor, "w", encoding="utf-8", closefd=False) for descriptor in (1, 2))  # noqa: SIM115
    faulthandler.enable(os.fdopen(os.dup(2), "w"))  # stages keep what libraries print on 2
    # numba guards its threads by a semaphore, which forked processes share: one that is killed while it holds it would keep all others waiting for ever.
    if "numba" in sys.modules:
        importlib.import_module("numba.np.ufunc.parallel")._set_init_process_lock()
    from workflows.cli.main import main

    if armed is not None and python_alone():
        from benchmarks.torture.audit import arm

        arm()
    elif armed is not None and not ctypes.CDLL(None).trap_arm():
        raise RuntimeError("the trap could not be armed")
    try:
        return main(list(arguments), workflow)
    finally:
        if names := os.environ.get("TORTURE_MODULES"):
            Path(names).write_text("\n".join(sys.modules), encoding="utf-8")


def preload() -> None:
    """Import every module of the project, and load the compiled kernels that there are; none is run."""
    import zlib  # noqa: F401  before pycolmap, should that be imported

    for package in map(importlib.import_module, PACKAGES):
        for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            if not any(name in module.name for name in LEFT_OUT):
                importlib.import_module(module.name)
    load_kernels()


def preload_modules(names: Sequence[str]) -> None:
    """Import what a run had imported in the end."""
    for name in names:
        if name not in sys.modules and not any(part in name for part in LEFT_OUT):
            with contextlib.suppress(Exception):
                importlib.import_module(name)
    load_kernels()


_loaded: set[int] = set()


def load_kernels() -> None:
    """Load kernels from numba's files, and keep all that there is from the garbage collector. Loading starts the (empty) pool of one thread; OpenMP refuses to
    be used by children of the process that did this, not by their children: see `forked`."""
    from numba.core.dispatcher import Dispatcher

    for module in [module for name, module in list(sys.modules.items()) if name.startswith("efficientnerf")]:
        for value in list(vars(module).values()):
            if isinstance(value, Dispatcher) and id(value) not in _loaded:
                _loaded.add(id(value))
                index = getattr(getattr(value, "_cache", None), "_cache_file", None)
                for signature, *_ in [] if index is None else list(index._load_index()):
                    value.compile(signature)
    gc.collect()
    gc.freeze()


def forked(work: Callable[[], int | None]) -> int:
    """Call a function in a child process, whose children may use OpenMP; its pid. The exit code is what the function returns, or SystemExit has."""
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid:
        return pid
    try:
        code = work() or 0
    except SystemExit as error:
        code = error.code if isinstance(error.code, int) else 1
        if not isinstance(error.code, int):
            print(error.code, file=sys.stderr)
    except BaseException:
        traceback.print_exc()
        code = 1
    with contextlib.suppress(OSError):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(code)
