"""Real processes that are killed at a chosen moment."""

import os
import signal
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pipeline import files

# Everything durable goes through these.
STEPS = ("rename", "sync_folder", "sync_file", "remove")


def run_and_kill(action: Callable[[], Any], moment: int) -> bool:
    """Run in a forked process that is killed (SIGKILL) before its `moment`-th durable step, counted from 1; whether it came to that.

    Before it is killed within `remove`, one file of what was to be removed is gone already.
    """
    pid = os.fork()
    if pid == 0:
        try:
            _arm(moment)
            action()
            os._exit(0)
        except BaseException:
            traceback.print_exc(file=sys.stderr)
            os._exit(1)
    _, status = os.waitpid(pid, 0)
    assert os.WIFSIGNALED(status) or os.WEXITSTATUS(status) == 0, "the child failed by itself"
    return os.WIFSIGNALED(status)


def _arm(moment: int) -> None:
    left = moment

    def armed(name: str, step: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            nonlocal left
            left -= 1
            if left == 0:
                if name == "remove":
                    _remove_one(Path(arguments[0]))
                os.kill(os.getpid(), signal.SIGKILL)
            return step(*arguments)

        return call

    for name in STEPS:
        setattr(files, name, armed(name, getattr(files, name)))


def _remove_one(folder: Path) -> None:
    if folder.is_dir():
        # The manifest first: the worst order for who would take what is left for an artifact.
        found = sorted(path for path in folder.rglob("*") if path.is_file())
        found.sort(key=lambda path: path.name != "manifest.json")
        if found:
            found[0].unlink()
