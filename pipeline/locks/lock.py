"""One writer at a time: an operating system's lock on RUN/.lock, a note of its holder, and a lease for other machines that share the folder.

The lock ends with its process: a killed process never blocks a run on its own machine. On another the run is free once the lease has expired.
"""

import contextlib
import errno
import os
import shlex
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec

from pipeline import files
from pipeline.errors import BadInput, PipelineError, RunLocked
from pipeline.failures import cannot_write
from pipeline.links import HOLDER, LOCK
from pipeline.locks.lease import EXPIRY, Held, Lease, acquire, age_of
from pipeline.text import printable

_GONE = 10 * EXPIRY  # seconds without a renewed lease, from which a process of another machine has ended, though clocks differ
_NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP)


@dataclass(frozen=True)
class Holder:
    """Who writes a run; `since` in seconds since 1970. Anybody may have written the note that this is read from."""

    pid: Annotated[int, msgspec.Meta(ge=1, le=2**31 - 1)]
    host: Annotated[str, msgspec.Meta(max_length=255)]
    since: Annotated[float, msgspec.Meta(ge=0, le=1e11)]
    command: Annotated[str, msgspec.Meta(max_length=1000)]

    def text(self) -> str:
        since = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(self.since))
        return f"process {self.pid} on {printable(self.host, 80)} since {since} ({printable(self.command, 500)})"


def holder_of(run: Path) -> Holder | None:
    """The process that holds the lock by HOLDER, if it may still be alive. Takes no lock, writes nothing."""
    try:
        holder = msgspec.convert(files.read_json(run / HOLDER, limit=2**16, follow=False), Holder)
    except (OSError, ValueError):  # of msgspec, too
        return None
    if holder.host == socket.gethostname():
        return holder if _is_alive(holder.pid) else None
    age = age_of(run)
    return holder if age is None or age < _GONE else None


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


@contextmanager
def lock(folder: Path) -> Iterator[Lease]:
    """Hold the lock of a run or a fleet. Raises RunLocked at once if another holds it, BadInput if the folder cannot be written."""
    import filelock  # not needed by the commands that only read

    # A soft lock would be a file that stays when its process is killed.
    guard = filelock.FileLock(folder / LOCK, timeout=0, thread_local=False, fallback_to_soft=False)
    try:
        guard.acquire()
        decisive = True
    except filelock.Timeout:
        raise RunLocked(f"{folder}: being written by {_who(folder)}. Wait until it is done, or stop it.") from None
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise _cannot_lock(folder, error) from None
        decisive = False  # a file system without such locks: the lease alone says who writes
    try:
        with _leased(folder, decisive) as lease:
            yield lease
    finally:
        with contextlib.suppress(OSError):
            guard.release()


@contextmanager
def _leased(folder: Path, decisive: bool) -> Iterator[Lease]:
    try:
        lease = acquire(folder, decisive=decisive)
    except Held as held:
        since = f"its lease was renewed {max(0.0, held.age):.0f} s ago; {EXPIRY:.0f} s after the last time it is free"
        raise RunLocked(f"{folder}: being written by {_who(folder)}; {since}. Wait until it is done, or stop it.") from None
    except OSError as error:
        raise _cannot_lock(folder, error) from None
    try:
        _write_holder(folder)
        yield lease
    finally:
        # An error in flight is the one to report, and without one all is done: a note of a dead process does no harm, and the lock ends with its process.
        if lease.lost() is None:
            with contextlib.suppress(OSError):
                (folder / HOLDER).unlink(missing_ok=True)
        lease.release()


def _who(folder: Path) -> str:
    holder = holder_of(folder)
    return holder.text() if holder is not None else "a process that did not say who it is"


def _cannot_lock(run: Path, error: OSError) -> PipelineError:
    found = cannot_write(run, error)
    return BadInput(f"{run}: cannot be locked for writing ({error.strerror or error})") if isinstance(found, BadInput) else found


def _write_holder(run: Path) -> None:
    command = shlex.join([Path(sys.argv[0] or "python").name, *sys.argv[1:]])[:500]
    holder = {"pid": os.getpid(), "host": socket.gethostname(), "since": time.time(), "command": command}
    with contextlib.suppress(OSError):  # the lock holds without it: only the message of a second run would be poorer
        files.write_atomically(run / HOLDER, files.pretty_json(holder))
