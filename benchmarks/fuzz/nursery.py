"""A process that has imported everything, and forks a worker for each batch of inputs: importing takes longer than thousands of inputs."""

import contextlib
import io
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.fuzz import worker
from benchmarks.fuzz.reader import commanded, judged, quiet
from benchmarks.project import ROOT

MEMORY = "/dev/shm"  # files there are written ten times as fast as on a disk
STUCK = 180.0  # seconds without a new input after which a worker is ended: it does not answer to signals
IMPORTING = 600.0  # seconds


def scratch_folder(prefix: str) -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix=prefix, dir=MEMORY if os.path.isdir(MEMORY) else None)


def serve(coverage: bool) -> None:
    """Work off the jobs on stdin, a line of JSON each: the process id of the worker and then its exit code are printed."""
    quiet()
    os.environ.update(NUMBA_NUM_THREADS="1", OMP_NUM_THREADS="1")
    with scratch_folder("fuzz-nursery-") as folder:
        tempfile.tempdir = folder
        _import_all(Path(folder), coverage)
        print("ready", flush=True)
        for line in sys.stdin:
            pid = os.fork()
            if pid == 0:
                _be_born(json.loads(line))
            print(pid, flush=True)
            print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)


def _import_all(folder: Path, coverage: bool) -> None:
    """Open each reader, read a valid file and call its commands."""
    instrumented: contextlib.AbstractContextManager[Any] = contextlib.nullcontext()
    if coverage:
        import atheris

        instrumented = atheris.instrument_imports(include=worker.INSTRUMENTED)
    with instrumented, contextlib.redirect_stderr(io.StringIO()):
        from benchmarks.fuzz.table import READERS

        for reader in READERS.values():
            (folder / reader.name).mkdir()
            opened, data = reader.open(folder / reader.name), reader.seeds()[0]
            judged(lambda opened=opened, data=data: opened.read(data), reader.refusals, limited=False)  # type: ignore[misc]
            for arguments in (each for each in opened.commands if each[0] != "render"):  # OpenMP ends processes that are forked after it ran
                opened.prepare(data)
                commanded(arguments, limited=False)  # what is cut short while it is imported stays broken


def _be_born(job: dict[str, Any]) -> None:
    """In the child: do the job, and end."""
    try:
        folder = Path(job["folder"])
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        for number, name in ((1, "stdout"), (2, "stderr")):
            os.dup2(os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        worker.work(**{**job, "folder": folder})
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        os._exit(1)


class Nursery:
    """The process, seen from the campaign."""

    def __init__(self, coverage: bool) -> None:
        command = [sys.executable, "-m", "benchmarks.fuzz", "--serve", *([] if coverage else ["--plain"])]
        self.process = subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)
        if self._line(IMPORTING) != "ready":
            raise RuntimeError("the fuzzer's readers cannot be opened; try `python -m benchmarks.fuzz --serve`")

    def work(self, job: dict[str, Any], note: Path) -> int | None:
        """The exit code of a worker that did the job; None where it had to be killed because it came to no new input."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(job).encode() + b"\n")
        pid = int(self._line(STUCK) or 0)
        last, since, killed = b"", time.monotonic(), False
        while (line := self._line(1.0)) is None:
            now = note.read_bytes()[:20] if note.exists() else b""
            if now != last:
                last, since = now, time.monotonic()
            if time.monotonic() - since > STUCK:
                os.kill(pid, signal.SIGKILL)
                killed = True
        return None if killed else int(line)

    def _line(self, seconds: float) -> str | None:
        """The next line that it prints; None where there is none within so many seconds."""
        assert self.process.stdout is not None
        return self.process.stdout.readline().decode().strip() if select.select([self.process.stdout], [], [], seconds)[0] else None
