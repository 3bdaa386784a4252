"""The process that structure from motion runs in; `stages.sfm.process` starts it and states the protocol."""

import os
import signal
import sys
import traceback
from typing import Any

from pipeline.executors.pipes import Channel, end_with
from pipeline.failures import history
from pipeline.library_output import warnings_for_users
from pipeline.stage import ByName

TASKS = {"pairs": ByName("stages.sfm.pair_workers:match_for"), "cameras": ByName("stages.sfm.cameras:capture_for")}


class Stopped(Exception):
    """The parent asked to stop at a safe point."""


class _Channel(Channel):
    """The pipes to the parent, as the callables of a task."""

    def progress(self, *values: Any, **facts: Any) -> None:
        self.send({"event": "progress", "values": values, "facts": facts})

    def warn(self, text: str, **facts: Any) -> None:
        self.send({"event": "warning", "text": text, "facts": facts})

    def safe_point(self) -> None:
        self.send({"event": "safe point"})
        if self.receive() != "go":
            raise Stopped


def main() -> None:
    """Do the parent's task for its arguments, and end."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT, signal.SIGTERM))
    channel = _Channel()
    request = channel.receive()
    end_with(request["parent"])
    try:
        with warnings_for_users(channel.warn):
            value = TASKS[request["task"]](request["arguments"], progress=channel.progress, safe_point=channel.safe_point, warn=channel.warn)
    except BaseException as error:
        if not any(isinstance(each, Stopped) for each in history(error)):  # COLMAP wraps it where it passes through a callback
            facts: dict[str, Any] = {"type": type(error).__name__, "text": str(error), "errno": None, "strerror": None, "filename": None}
            if isinstance(error, OSError):
                name = os.fsdecode(error.filename) if isinstance(error.filename, str | bytes) else None
                facts |= {"errno": error.errno, "strerror": error.strerror, "filename": name}
            channel.send({"event": "error", **facts, "traceback": "".join(traceback.format_exception(error))})
    else:
        channel.send({"event": "result", "value": value})
    sys.stderr.flush()
    os._exit(0)  # libraries that take the process down while they are unloaded have no say


if __name__ == "__main__":
    main()
