"""SHA-256 of files, remembered by size, modification time and inode so that an unchanged run is recognised without reading it."""

from __future__ import annotations

import hashlib
import os
import re
import time
from pathlib import Path
from typing import Any

from pipeline import files
from pipeline.files import SafePoint

CHUNK = 2**20  # bytes between two safe points
FORMAT = "enerf-hashes-1"
# A file changed again within one tick of the file system's clock keeps its modification time (4-10 ms on Linux). What was modified this
# recently when it was hashed is not remembered but hashed again the next time.
SETTLED_NS = 20_000_000


def sha256_of(path: Path, safe_point: SafePoint | None = None) -> str:
    """Hex digest of a file's bytes."""
    digest = hashlib.sha256()
    with open(path, "rb", buffering=0) as file:
        while chunk := file.read(CHUNK):
            digest.update(chunk)
            if safe_point is not None:
                safe_point()
    return digest.hexdigest()


class Hashes:
    """Digests of files by key, where a key is the file's place within the run (or within the source), which moves with it.

    path   the file that remembers them between processes; None: nothing is remembered. A damaged one is ignored: it only saves time
    trust  False: read every file, whatever is remembered
    """

    def __init__(self, path: Path | None = None, *, trust: bool = True, safe_point: SafePoint | None = None) -> None:
        self.path = path
        self.trust = trust
        self.safe_point = safe_point
        self._changed = False
        self._entries: dict[str, tuple[int, int, int, str]] = {} if path is None else _read(path)

    def digest(self, key: str, path: Path, *, anew: bool = False) -> str:
        """Of the file at `path`, which is or will be at the place `key`. Raises OSError if it cannot be read.

        anew  read it whatever is remembered, and without a safe point: what a stage has just finished is not given up for a Ctrl-C
        """
        before = os.stat(path)
        known = self._entries.get(key)
        if self.trust and not anew and known is not None and known[:3] == _identity(before):
            return known[3]
        started = time.time_ns()
        digest = sha256_of(path, None if anew else self.safe_point)
        after = os.stat(path)
        if _identity(after) == _identity(before) and after.st_mtime_ns < started - SETTLED_NS:
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
            files.write_atomically(self.path, files.canonical_json({"format": FORMAT, "files": self._entries}))
            self._changed = False
        except OSError:
            pass


def _identity(stat: os.stat_result) -> tuple[int, int, int]:
    return stat.st_size, stat.st_mtime_ns, stat.st_ino


def _read(path: Path) -> dict[str, tuple[int, int, int, str]]:
    try:
        value = files.read_json(path, limit=4 * files.MAX_JSON)
    except (files.Unreadable, FileNotFoundError, NotADirectoryError):
        return {}
    if not isinstance(value, dict) or value.get("format") != FORMAT or not isinstance(value.get("files"), dict):
        return {}
    return {key: (entry[0], entry[1], entry[2], entry[3]) for key, entry in value["files"].items() if _is_entry(entry)}


def _is_entry(entry: Any) -> bool:
    return (
        isinstance(entry, list)
        and len(entry) == 4
        and all(type(number) is int for number in entry[:3])
        and isinstance(entry[3], str)
        and re.fullmatch(r"[0-9a-f]{64}", entry[3]) is not None
    )
