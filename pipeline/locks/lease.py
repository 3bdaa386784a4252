"""A lease: who writes a folder, across machines that share it, without a lock service.

    FOLDER/.lease/<number>   one file for each holder, its number one above that of the holder before; modified by its holder every RENEWAL_SECONDS seconds

The highest number holds. It is free where it was not modified for EXPIRY seconds, by the clock of the file server alone: the clocks of machines differ.
Who finds it free creates the next number, which exactly one can: a file is written aside and linked to its name, as is safe on NFS, or created with
O_EXCL where there are no links. No number is ever given twice while a higher one is there, so that a process that was slow finds out. A holder
that finds a higher number than its own, or could not renew its own for EXPIRY seconds, has lost the lease and must write nothing more.

Within one machine an operating system's lock decides (`pipeline.locks.lock`): its holder may take over at once from a process of the same machine.
"""

import contextlib
import errno
import json
import os
import secrets
import socket
import threading
import time
import uuid
from functools import cache
from pathlib import Path

from pipeline import files
from pipeline.errors import CorruptArtifact
from pipeline.links import LEASE

EXPIRY = 60.0  # seconds
RENEWAL_SECONDS = 10.0
_MOST = 10**15  # a number that no count of holders reaches
_TRIES = 100
_PART = ".part"
_NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.ENOSYS, errno.EOPNOTSUPP, errno.EMLINK)


class Held(Exception):
    """Another holds the lease."""

    def __init__(self, age: float) -> None:
        super().__init__(f"renewed {age:.0f} s ago")
        self.age = age  # seconds since it was last renewed


class Lease:
    """A lease that is held. Renewed by a thread until `release`."""

    def __init__(self, folder: Path, number: int) -> None:
        self.path = folder / str(number)
        self.number = number
        self._renewed = time.monotonic()
        self._why_lost: str | None = None
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._renew, name=f"lease {self.path}", daemon=True)
        self._thread.start()

    def lost(self) -> str | None:
        """Why it is no longer held, or None."""
        return self._why_lost

    def beat(self) -> None:
        """Renew it, if it is still held."""
        try:
            if max(_numbers(self.path.parent), default=self.number) > self.number:
                self._why_lost = "another process took its lease over, which had expired"
                return
            os.utime(self.path)  # no time given: the file server's
            self._renewed = time.monotonic()
        except FileNotFoundError:
            self._why_lost = "its lease was removed"
        except OSError as error:
            if time.monotonic() - self._renewed > EXPIRY:
                self._why_lost = f"its lease could not be renewed for {EXPIRY:.0f} s ({error.strerror})"

    def release(self) -> None:
        """Free it for the next at once. Its file stays: numbers only rise."""
        self._done.set()
        self._thread.join()
        if self._why_lost is None:
            with contextlib.suppress(OSError):  # it expires, then
                os.utime(self.path, (0, 0))

    def _renew(self) -> None:
        while not self._done.wait(RENEWAL_SECONDS) and self._why_lost is None:
            self.beat()


def acquire(folder: Path, *, decisive: bool) -> Lease:
    """Take the lease on `folder`. Raises Held, and OSError.

    decisive  whether this process holds a lock that no other of this machine holds: then a lease of this machine is that of a dead process
    """
    place = folder / LEASE
    place.mkdir(exist_ok=True)
    for _ in range(_TRIES):
        numbers = _numbers(place)
        last = max(numbers, default=0)
        if last >= _MOST:
            raise CorruptArtifact(f"{folder}: {LEASE}/{last} is no number of a lease. Remove {LEASE}.", (LEASE,))
        token = secrets.token_hex(8)
        aside = place / f"{token}{_PART}"
        aside.write_text(json.dumps({"machine": machine(), "token": token}))
        try:
            if last and (age := _age(place / str(last), aside)) < EXPIRY and not (decisive and _machine_of(place / str(last)) == machine()):
                raise Held(age)
            if not _create(aside, place / str(last + 1)):
                continue
        finally:
            aside.unlink(missing_ok=True)
        if max(_numbers(place), default=0) > last + 1:  # this one was slow: numbers had gone on, and lower ones been removed
            (place / str(last + 1)).unlink(missing_ok=True)
            continue
        _clear(place, last + 1)
        return Lease(place, last + 1)
    raise Held(0.0)


def age_of(folder: Path) -> float | None:
    """Seconds since the lease on `folder` was renewed, by the clock of this machine, which may go differently; None where there is none. Writes nothing."""
    place = folder / LEASE
    try:
        return time.time() - os.stat(place / str(max(_numbers(place))), follow_symlinks=False).st_mtime
    except (OSError, ValueError):
        return None


@cache
def machine() -> str:
    """A unique identifier of this machine, while it runs."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return f"{socket.gethostname()} {uuid.getnode():x}"


def _numbers(place: Path) -> list[int]:
    return [int(name) for name in os.listdir(place) if name.isascii() and name.isdigit() and len(name) <= 18]


def _age(path: Path, now: Path) -> float:
    """Seconds between the last changes of two files, by the clock of who stores them; of one that has gone: none."""
    try:
        return os.stat(now).st_mtime - os.stat(path, follow_symlinks=False).st_mtime
    except FileNotFoundError:
        return 0.0


def _machine_of(path: Path) -> str | None:
    try:
        found = files.read_json(path, limit=2**12, follow=False)
    except (OSError, files.Unreadable):
        return None
    return found.get("machine") if isinstance(found, dict) else None


def _create(aside: Path, path: Path) -> bool:
    """Give the file its name, unless another has it; whether that was done."""
    try:
        os.link(aside, path, follow_symlinks=False)
    except FileExistsError:
        return False
    except OSError as error:
        if os.stat(aside).st_nlink == 2:  # it was done, and only the answer was lost
            return True
        if error.errno not in _NO_LINKS:
            raise
        try:
            descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        except FileExistsError:
            return False
        with open(descriptor, "wb") as file:
            file.write(aside.read_bytes())
    return True


def _clear(place: Path, number: int) -> None:
    """Remove lower numbers, and what kills left aside."""
    now = place / str(number)
    with contextlib.suppress(OSError):
        for path in list(place.iterdir()):
            lower = path.name.isascii() and path.name.isdigit() and len(path.name) <= 18 and int(path.name) < number
            if lower or (path.name.endswith(_PART) and _age(path, now) > EXPIRY):
                path.unlink(missing_ok=True)
