"""SHA-256 of files, remembered by size, times and inode so that an unchanged run is recognised without reading it."""

import hashlib
import os
import time
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from pipeline import files
from pipeline.files import SafePoint

CHUNK = 2**20  # bytes between two safe points
FORMAT = "enerf-hashes-2"
# A file changed again within one tick of the file system's clock keeps its times (4-10 ms on Linux's own, 2 s on FAT). What was changed this
# recently when it was hashed is not remembered but hashed again the next time.
SETTLED_NS = 2_100_000_000

Sha256 = Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{64}\Z")]
Entry = tuple[int, int, int, int, Sha256]


class _Memory(msgspec.Struct):
    """The file that remembers."""

    format: Literal["enerf-hashes-2"]
    files: dict[str, Entry]


def sha256_of(path: Path, safe_point: SafePoint | None = None, *, follow: bool = True) -> str:
    """Hex digest of a plain file's bytes. Raises OSError; see `pipeline.files.open_plain`."""
    digest = hashlib.sha256()
    with open(files.open_plain(path, follow=follow), "rb", buffering=0) as file:
        while chunk := file.read(CHUNK):
            digest.update(chunk)
            if safe_point is not None:
                safe_point()
    return digest.hexdigest()


class Hashes:
    """Digests of files by key, where a key is the file's place within the run (or within the source), which moves with it."""

    def __init__(self, path: Path | None = None, *, safe_point: SafePoint | None = None) -> None:
        self.path = path  # the file that remembers them between processes; None: nothing is remembered. A damaged one is ignored: it only saves time
        self.safe_point = safe_point
        self._changed = False
        self._entries: dict[str, Entry] = {} if path is None else _read(path)

    def digest(self, key: str, path: Path, *, anew: bool = False, follow: bool = True) -> str:
        """Digest of the file at `path`, to be at the place `key`. Raises OSError if it cannot be read.

        anew    read it whatever is remembered, and without a safe point: what a stage has just finished is not given up for a Ctrl-C
        """
        before = os.stat(path, follow_symlinks=follow)
        known = self._entries.get(key)
        if not anew and known is not None and known[:4] == _identity(before):
            return known[4]
        started = time.time_ns()
        digest = sha256_of(path, None if anew else self.safe_point, follow=follow)
        after = os.stat(path, follow_symlinks=follow)
        if _identity(after) == _identity(before) and max(after.st_mtime_ns, after.st_ctime_ns) < started - SETTLED_NS:
            self._entries[key] = (*_identity(after), digest)
            self._changed = True
        elif self._entries.pop(key, None) is not None:
            self._changed = True
        return digest

    def forget(self, prefix: str, keep: set[str] | frozenset[str] = frozenset()) -> None:
        """Drop the keys with this prefix other than those to keep."""
        for key in [key for key in self._entries if key.startswith(prefix) and key not in keep]:
            del self._entries[key]
            self._changed = True

    def save(self) -> None:
        """Best effort: on a full or read-only disk the next run reads the files again."""
        if self.path is None or not self._changed:
            return
        try:
            self.path.parent.mkdir(exist_ok=True)
            files.remove_temporaries(self.path.parent, self.path.name)
            files.write_atomically(self.path, files.canonical_json({"format": FORMAT, "files": self._entries}))
            self._changed = False
        except OSError:
            pass


def _identity(stat: os.stat_result) -> tuple[int, int, int, int]:
    """Also the time of the last change of the file's status: anybody may set its modification time back."""
    return stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino


def _read(path: Path) -> dict[str, Entry]:
    try:
        return msgspec.convert(files.read_json(path, follow=False), _Memory).files
    except (OSError, ValueError):  # unreadable, or of another form; both of msgspec's errors are ValueErrors
        return {}
