"""A child process that runs a module, and lines of JSON to and from it: `Child` is the parent's end, `Channel` the child's.

A child ends with its parent, and what it prints is no message.
"""

import contextlib
import ctypes
import json
import os
import queue
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Mapping
from typing import Any

KEPT_LINES = 200  # of standard error
_LONGEST_BYTES = 2**14  # of a line of standard error; the rest is another line
JOIN_SECONDS = 20.0  # seconds that the end of standard error may take once the child has ended
_PR_SET_PDEATHSIG = 1  # prctl(2), Linux alone

# An entry of sys.path that is empty stands for the working folder, which may hold anything: the parent's own entries take its place first.
_BOOTSTRAP = "import sys, runpy; name = sys.argv.pop(1); sys.path[:] = sys.argv[1:]; del sys.argv[1:]; runpy.run_module(name, run_name='__main__')"


def end_with(parent: int) -> None:
    """Let this process die as soon as its parent does, even while a library keeps Python from running."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def command_for(module: str) -> list[str]:
    """The command that runs a module as a child, with the import path of this process."""
    paths = [os.getcwd() if entry == "" else entry for entry in sys.path]
    return [sys.executable, "-c", _BOOTSTRAP, module, *paths]


class Child:
    """One process and its pipes.

    lines  the last lines of its standard error that are not blank
    """

    def __init__(self, module: str, *, group: bool = False, env: Mapping[str, str] | None = None) -> None:
        """Start the module, as the leader of a group of processes where `group`, in this environment (None: that of this process)."""
        self.process = subprocess.Popen(
            command_for(module), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=group, env=env
        )
        self.lines: deque[str] = deque(maxlen=KEPT_LINES)
        self._listener = threading.Thread(target=self._listen, name=f"standard error of {module}", daemon=True)
        self._listener.start()

    def write(self, message: object) -> None:
        assert self.process.stdin is not None
        with contextlib.suppress(OSError, ValueError):  # a child that has ended is noticed where it is read from
            self.process.stdin.write(json.dumps(message).encode() + b"\n")
            self.process.stdin.flush()

    def close(self) -> None:
        """Read the rest of its standard error and close the pipes, once it has ended or was killed."""
        self.process.wait()
        self._listener.join(JOIN_SECONDS)
        for pipe in (self.process.stdin, self.process.stdout, self.process.stderr):
            with contextlib.suppress(OSError):
                assert pipe is not None
                pipe.close()

    def _listen(self) -> None:
        assert self.process.stderr is not None
        with contextlib.suppress(OSError, ValueError):
            while line := self.process.stderr.readline(_LONGEST_BYTES):
                if line.strip():
                    self.lines.append(line.decode("utf-8", "replace"))


class Channel:
    """The pipes to the parent: standard input and output, which nothing else uses from here on. Sent to from any number of threads."""

    def __init__(self) -> None:
        self._out = os.dup(1)
        os.dup2(2, 1)  # what a library prints is no message
        self._lines: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._lock = threading.Lock()
        threading.Thread(target=self._read, name="messages of the parent", daemon=True).start()

    def _read(self) -> None:
        message = None
        with open(0, "rb", closefd=False) as lines:
            for line in lines:
                message = json.loads(line)
                self._lines.put(message)
        if message != {"kind": "end"}:  # the parent has gone: the run may be another's by now
            _end()

    def send(self, message: Mapping[str, Any]) -> None:
        data = memoryview(json.dumps(message, default=str).encode() + b"\n")
        try:
            with self._lock:
                while data:
                    data = data[os.write(self._out, data) :]
        except BrokenPipeError:
            _end()

    def receive(self) -> Any:
        """The next message of the parent."""
        return self._lines.get()


def _end() -> None:
    """End at once, with all that this process has started where it leads a group."""
    if os.getpgrp() == os.getpid():
        os.killpg(0, signal.SIGKILL)
    os._exit(1)
