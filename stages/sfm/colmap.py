"""pycolmap, imported without harm and without its log."""

import contextlib
import ctypes
import importlib.util
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pipeline.errors import BadInput, StageFailed
from pipeline.files import open_plain, remove
from pipeline.text import printable

# glog installs handlers of these when pycolmap is imported; they print a stack trace and abort, at SIGTERM too.
_GLOG_SIGNALS = (signal.SIGSEGV, signal.SIGILL, signal.SIGFPE, signal.SIGABRT, signal.SIGBUS, signal.SIGTERM)
_LOG = "colmap_log."  # beginning of the names of its files; glog adds the time and the process
_SIGACTION_BYTES = 1024  # bytes; a struct sigaction takes 152 on Linux


def import_pycolmap() -> Any:
    """Import pycolmap; nothing else does.

    zlib, numpy and Pillow come first: the libraries inside of pycolmap 4 hide those of the same names that are loaded later, and zlib then frees what
    it never had. Signal handlers are restored afterwards, by sigaction(2): Python's signal module knows nothing of handlers that faulthandler or
    another library has set, and works in the main thread only. Raises BadInput where it is not installed.
    """
    if "pycolmap" not in sys.modules:
        if importlib.util.find_spec("pycolmap") is None:
            raise BadInput("cameras of photographs need pycolmap, which has no wheels for this system. Build it, or give cameras of another program.")
        import zlib  # noqa: F401 (see above)

        import numpy  # noqa: F401 (see above)
        import PIL.Image  # noqa: F401 (see above)

        libc = ctypes.CDLL(None)
        handlers = [(number, ctypes.create_string_buffer(_SIGACTION_BYTES)) for number in _GLOG_SIGNALS]
        for number, handler in handlers:
            libc.sigaction(int(number), None, handler)
        # A SIGTERM that arrives meanwhile is delivered to the restored handler.
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
        try:
            import pycolmap  # see above
        finally:
            for number, handler in handlers:
                libc.sigaction(int(number), handler, None)
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)
    import pycolmap  # see above

    return pycolmap


@contextlib.contextmanager
def quiet_pycolmap() -> Iterator[Any]:
    """pycolmap with its log silenced, except for fatal errors."""
    pycolmap = import_pycolmap()
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 3
    try:
        yield pycolmap
    finally:
        pycolmap.logging.minloglevel = before


@contextlib.contextmanager
def every_image_read(pycolmap: Any, folder: Path) -> Iterator[None]:
    """Raise StageFailed where COLMAP could not read an image within: it only logs that, and goes on to another result.

    folder  for the log, which is removed
    """
    log = pycolmap.logging
    names = ("minloglevel", "stderrthreshold", "logtostderr", "alsologtostderr")
    before = {name: getattr(log, name) for name in names}
    log.set_log_destination(log.WARNING, str(folder / _LOG))
    log.minloglevel, log.stderrthreshold, log.logtostderr, log.alsologtostderr = 1, 3, False, False
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(log, name, value)
        log.set_log_destination(log.WARNING, "")
        lines = [line for path in sorted(folder.glob(f"{_LOG}*")) for line in _lines(path)]
        for path in folder.glob(f"{_LOG}*"):
            remove(path)
    unread = next((line for line in lines if "Could not read image" in line), None)
    if unread is not None:
        raise StageFailed(f"poses: {printable(unread.partition('] ')[2], 300)} Run again: what is done is kept.")


def _lines(path: Path) -> list[str]:
    with open(open_plain(path, follow=False), encoding="utf-8", errors="replace") as file:
        return file.read(2**20).splitlines()
