"""Output of libraries goes to a log, not to users: their warnings, `logging`, uncaught errors.

A warning is shown where its category has `for_users`: those are ours, from code that knows of no display.

While a command runs, standard error's descriptor, 2, leads into the log, so that what C code and children write goes there, too. The log is a temporary file,
and `.cache/libraries.log` of a run while its stages run; `--debug` shows it in the end.
"""

import contextlib
import io
import logging
import os
import sys
import tempfile
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from pipeline.links import CACHE
from pipeline.text import printable

Say = Callable[[str], object]

NAME = "libraries.log"
MOST_SHOWN = 2**20  # bytes of the log that --debug shows: its end


@contextmanager
def warnings_for_users(say: Say) -> Iterator[None]:
    """While open, the texts of warnings for users go to `say`; all others where they went before."""
    former = warnings.showwarning

    def show(message: Any, category: Any, *where: Any, **more: Any) -> None:
        if getattr(category, "for_users", False):
            say(str(message))
        else:
            former(message, category, *where, **more)

    warnings.showwarning = show
    try:
        yield
    finally:
        warnings.showwarning = former


@contextmanager
def into_log(log: TextIO) -> Iterator[None]:
    """While open, all output of libraries through Python goes to `log`."""
    former = warnings.showwarning, sys.unraisablehook, threading.excepthook
    root = logging.getLogger()
    handler = logging.StreamHandler(log)

    def warned(message: Any, category: Any, filename: str, lineno: int, file: Any = None, line: str | None = None) -> None:
        log.write(warnings.formatwarning(message, category, filename, lineno, line))

    def uncaught(of: Any) -> None:
        log.write("".join(traceback.format_exception(of.exc_type, of.exc_value, of.exc_traceback)))

    warnings.showwarning, sys.unraisablehook, threading.excepthook = warned, uncaught, uncaught
    root.addHandler(handler)
    try:
        yield
    finally:
        root.removeHandler(handler)
        warnings.showwarning, sys.unraisablehook, threading.excepthook = former


@contextmanager
def libraries_apart(*, show: bool) -> Iterator[TextIO | None]:
    """While open, nothing but what is written to the stream that it yields, the former `sys.stderr`, comes to the terminal."""
    former = sys.stderr
    with contextlib.suppress(OSError, ValueError, AttributeError):
        former.flush()
    terminal = os.dup(2)
    stream: TextIO | None = former
    if _is_descriptor_2(former):  # else it leads elsewhere already
        stream = io.open(terminal, "w", encoding=former.encoding, errors=former.errors, buffering=1, closefd=False)  # noqa: SIM115, UP020
    log = _temporary()
    os.dup2(log, 2)
    try:
        with open(2, "w", encoding="utf-8", errors="backslashreplace", buffering=1, closefd=False) as text, into_log(text), warnings_for_users(_print):
            yield stream
    finally:
        os.dup2(terminal, 2)
        if show:
            _show(log, stream)
        os.close(log)
        with contextlib.suppress(OSError, ValueError):
            if stream is not None and stream is not former:
                stream.close()
        os.close(terminal)


@contextmanager
def kept_in(run: Path) -> Iterator[None]:
    """While open, libraries write into the log of a run that is locked; where that cannot be made, as before. One that holds nothing does not stay."""
    path = run / CACHE / NAME
    try:
        path.parent.mkdir(exist_ok=True)
        path.unlink(missing_ok=True)
        log = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_APPEND | os.O_CLOEXEC, 0o666)
    except OSError:
        yield
        return
    former = os.dup(2)
    os.dup2(log, 2)
    try:
        yield
    finally:
        os.dup2(former, 2)
        with contextlib.suppress(OSError):
            size = os.fstat(log).st_size
            os.write(former, os.pread(log, MOST_SHOWN, max(0, size - MOST_SHOWN)))  # for --debug
            if size == 0:
                path.unlink()
        os.close(former)
        os.close(log)


def _temporary() -> int:
    """The descriptor of a file without a name; of the null device where the disk has no space for one."""
    try:
        with tempfile.TemporaryFile(buffering=0) as file:
            return os.dup(file.fileno())
    except OSError:
        return os.open(os.devnull, os.O_RDWR)


def _is_descriptor_2(stream: TextIO | None) -> bool:
    try:
        return stream is not None and stream.fileno() == 2
    except (OSError, ValueError):
        return False


def _print(text: str) -> None:
    print(f"enerf: {printable(text)}", file=sys.stderr, flush=True)


def _show(log: int, stream: TextIO | None) -> None:
    with contextlib.suppress(OSError, ValueError):
        said = os.pread(log, MOST_SHOWN, max(0, os.fstat(log).st_size - MOST_SHOWN)).decode("utf-8", "replace").splitlines()
        if said and stream is not None:
            print("\n".join(["enerf: libraries' output:", *map(printable, said)]), file=stream, flush=True)
