"""Structure from motion in a process of its own: an abort inside of COLMAP, or the system's out-of-memory killer, then fails the stage and does not end
the run.

The child is a fresh interpreter (`stages.sfm.child`), never a fork: threads of torch would not survive one. Both speak lines of JSON (see `Child`):

    to the child    {"parent": pid, "task": ..., "arguments": ...}, then a line "go" or "stop" for each safe point
    from the child  {"event": "progress" | "warning" | "safe point", ...}, in the end "result", "error" or "stopped"

At each safe point the child waits for the answer, so that signals are the parent's alone: the child ignores Ctrl-C and SIGTERM, and ends with its parent.
A child that comes to no safe point, as within one bundle adjustment, is killed soon after it was asked to stop: what it has written is used again.
"""

import builtins
import contextlib
import json
import os
import queue
import signal
import subprocess
import threading
from collections.abc import Callable, Mapping
from typing import Any, NoReturn

from pipeline import errors
from pipeline.errors import StageFailed
from pipeline.executors.pipes import Child
from pipeline.executors.side_by_side import FailureInChild
from pipeline.text import printable

_HANDLED = (signal.SIGINT, signal.SIGTERM)
_SHOWN_LINES, _SHOWN_CHARACTERS = 3, 240
POLL_SECONDS = 0.2  # seconds between two checks whether to stop, while the child says nothing
GRACE = 1.2  # seconds that the child has to come to a safe point, once it was asked to stop
_FRAMES = (" ", "\t", "*** ", "PC: @", "Current thread", "Thread 0x", "Stack (most", "Extension modules")  # beginnings of lines of a stack trace


class ChildAborted(StageFailed):
    """The process ended without an answer; the text has its last words."""


def run(
    arguments: Mapping[str, Any], *, progress: Callable[..., None], safe_point: Callable[[], None], warn: Callable[..., None], task: str = "cameras"
) -> Any:
    """The result of `stages.sfm.child` for `arguments`, which JSON can hold.

    task  "cameras" of photographs, or "pairs" to match

    The callables are called here, in the order in which the child calls them, and `safe_point` also while it is silent. Their exceptions stop the child
    at its next safe point, or `GRACE` seconds later, and pass on.
    An error of the child is raised again, of the same class. Raises ChildAborted where it ended without an answer.
    """
    child = _Child(task, arguments)
    try:
        while (message := child.receive(safe_point)) is not None:
            match message["event"]:
                case "progress":
                    progress(*message["values"], **message["facts"])
                case "warning":
                    warn(message["text"], **message["facts"])
                case "safe point":
                    safe_point()
                    child.write("go")
                case "error":
                    child.process.wait()
                    _raise(message)
                case "result":
                    child.process.wait()
                    return message["value"]
        code = child.process.wait()  # negative: the number of the signal that ended it
    except BaseException:
        child.stop()
        raise
    finally:
        child.close()
    raise ChildAborted(_end_in_words(code, child.last_words()))


class _Child(Child):
    """The child process and its pipes."""

    def __init__(self, task: str, arguments: Mapping[str, Any]) -> None:
        # Signals that arrive while the interpreter starts wait until the child ignores them; the mask is inherited.
        former = signal.pthread_sigmask(signal.SIG_BLOCK, _HANDLED)
        try:
            super().__init__("stages.sfm.child")
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, former)
        self._messages: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        threading.Thread(target=self._hear, name="messages of structure from motion", daemon=True).start()
        self.write({"parent": os.getpid(), "task": task, "arguments": arguments})

    def _hear(self) -> None:
        """Queue its messages; None once it has ended, with half a line or none."""
        assert self.process.stdout is not None
        with contextlib.suppress(OSError, ValueError):
            for line in self.process.stdout:
                if not line.endswith(b"\n") or not isinstance(message := json.loads(line), dict):
                    break
                self._messages.put(message)
        self._messages.put(None)

    def receive(self, idle: Callable[[], None]) -> dict[str, Any] | None:
        """The next message; None once the child has ended. `idle` is called again and again until then."""
        while True:
            try:
                return self._messages.get(timeout=POLL_SECONDS)
            except queue.Empty:
                idle()

    def stop(self) -> None:
        """Let the child end at its next safe point, or kill it; at once where this is interrupted."""
        try:
            self.write("stop")
            self.process.wait(GRACE)
        except subprocess.TimeoutExpired:
            self.process.kill()
        except BaseException:
            self.process.kill()
            raise

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        super().close()

    def last_words(self) -> list[str]:
        """The last lines of its standard error, without stack traces."""
        lines = [line for line in self.lines if not line.startswith(_FRAMES)]
        return [printable(line.strip(), _SHOWN_CHARACTERS) for line in lines[-_SHOWN_LINES:]]


def _raise(message: Mapping[str, Any]) -> NoReturn:
    """The child's error again: ours and Python's own by their class, any other as a RuntimeError that names it."""
    name, text, number = str(message["type"]), str(message["text"]), message["errno"]
    cause = FailureInChild(f"\n{message['traceback']}")
    if number is not None:
        raise OSError(number, message["strerror"], message["filename"]) from cause
    found = getattr(errors, name, None) or getattr(builtins, name, None)
    if isinstance(found, type) and issubclass(found, Exception) and not issubclass(found, OSError | UnicodeError):
        raise found(text) from cause
    raise RuntimeError(f"{name}: {text}" if text else name) from cause


def _end_in_words(code: int, last_words: list[str]) -> str:
    output = f" Its last words: {' / '.join(last_words)}." if last_words else ""
    if code == -signal.SIGKILL:
        return (
            f"poses: structure from motion was ended by SIGKILL, as a system that runs out of memory does.{output} Close other programs, or lower"
            " poses.feature_image_size or poses.max_features; what is done is kept."
        )
    how = f"by {_name_of(-code)}" if code < 0 else f"with code {code} and no result"
    return (
        f"poses: structure from motion ended {how}.{output} Run again. Should it end so again, lower poses.max_features, take out photographs, or install"
        " another version of pycolmap."
    )


def _name_of(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:  # real-time signals have no name
        return f"signal {number}"
