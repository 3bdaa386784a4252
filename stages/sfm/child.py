"""The process that structure from motion runs in; `stages.sfm.process` starts it and states the protocol."""

import json
import os
import queue
import signal
import sys
import threading
import traceback
from typing import Any

from pipeline.executors.child import end_with
from pipeline.library_output import warnings_for_users
from pipeline.stage import ByName

TASKS = {"pairs": ByName("stages.sfm.pair_workers:match_for"), "cameras": ByName("stages.sfm.cameras:capture_for")}


class Stopped(Exception):
    """The parent asked to stop at a safe point."""


class Channel:
    """The pipes to the parent: standard input and output, which nothing else uses from here on."""

    def __init__(self) -> None:
        self._out = os.dup(1)
        os.dup2(2, 1)  # what a library prints is no message
        self._lines: queue.SimpleQueue[Any] = queue.SimpleQueue()
        threading.Thread(target=self._read, name="answers of the parent", daemon=True).start()

    def _read(self) -> None:
        with open(0, "rb", closefd=False) as lines:
            for line in lines:
                self._lines.put(json.loads(line))
        os._exit(1)  # the parent has gone: its scratch folder may be another's by now

    def send(self, event: str, **facts: Any) -> None:
        data = memoryview(json.dumps({"event": event, **facts}).encode() + b"\n")
        try:
            while data:
                data = data[os.write(self._out, data) :]
        except BrokenPipeError:
            os._exit(1)

    def receive(self) -> Any:
        return self._lines.get()

    def progress(self, *values: Any, **facts: Any) -> None:
        self.send("progress", values=values, facts=facts)

    def warn(self, text: str, **facts: Any) -> None:
        self.send("warning", text=text, facts=facts)

    def safe_point(self) -> None:
        self.send("safe point")
        if self.receive() != "go":
            raise Stopped


def main() -> None:
    """Do the parent's task for its arguments, and end."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT, signal.SIGTERM))
    channel = Channel()
    request = channel.receive()
    end_with(request["parent"])
    try:
        with warnings_for_users(channel.warn):
            value = TASKS[request["task"]](request["arguments"], progress=channel.progress, safe_point=channel.safe_point, warn=channel.warn)
    except BaseException as error:
        if not _was_stopped(error):
            _send_error(channel, error)
    else:
        channel.send("result", value=value)
    sys.stderr.flush()
    os._exit(0)  # libraries that take the process down while they are unloaded have no say


def _was_stopped(error: BaseException | None) -> bool:
    """Whether it is Stopped, which COLMAP may have wrapped into an error of its own on the way through a callback."""
    while error is not None:
        if isinstance(error, Stopped):
            return True
        error = error.__cause__ or error.__context__
    return False


def _send_error(channel: Channel, error: BaseException) -> None:
    facts: dict[str, Any] = {"type": type(error).__name__, "text": str(error), "errno": None, "strerror": None, "filename": None}
    if isinstance(error, OSError):
        name = os.fsdecode(error.filename) if isinstance(error.filename, str | bytes) else None
        facts |= {"errno": error.errno, "strerror": error.strerror, "filename": name}
    channel.send("error", **facts, traceback="".join(traceback.format_exception(error)))


if __name__ == "__main__":
    main()
