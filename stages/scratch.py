"""Pieces of work in a stage's scratch folder for a later attempt, each with a note of the SHA-256 of its files.

Scratch is not synced: after a power cut a file may have its name and nothing, or half, of what was in it; and a run may come from someone else. A piece
counts only where the note and all of its files are as they were written, and the note's value is of the type that is expected. Else the note is
removed, and the piece is made again.
"""

import hashlib
import io
import json
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from pipeline import files
from pipeline.text import printable

T = TypeVar("T")
Warn = Callable[[str], object]


class _Note(msgspec.Struct, forbid_unknown_fields=True):
    """What is noted of a piece of work."""

    value: Any  # whatever the stage needs to know again
    files: dict[str, str]  # SHA-256 of each file by its path relative to the note's folder
    sha256: str  # of all this


def note(path: Path, value: Any, outputs: Sequence[Path] = ()) -> None:
    """Note that a piece is done: a value that JSON can hold, and the files that were written for it, in the note's folder or below. The last to be written."""
    digests = {output.relative_to(path.parent).as_posix(): digest_of(output) for output in outputs}
    text = json.dumps({"value": value, "files": digests, "sha256": _digest(value, digests)}, allow_nan=False)
    files.write_atomically(path, text.encode(), durable=False)


def noted(path: Path, kind: type[T], warn: Warn, check: Callable[[T, Collection[str]], object] | None = None) -> T | None:
    """The value of a note, of this type as msgspec decodes it; None where there is none that counts.

    warn   is called for a note that does not count
    check  is given the value and the names of the files, and raises where they are not what the stage needs
    """
    try:
        with opened(path) as file:
            found = msgspec.convert(json.loads(file.read(files.MAX_JSON)), _Note)
        if _digest(found.value, found.files) != found.sha256:
            raise ValueError("it is not as it was written")
        for name, digest in found.files.items():
            if not files.is_safe_name(name) or digest_of(path.parent / name) != digest:
                raise ValueError(f"{name} is not as it was written")
        value = msgspec.convert(found.value, kind)
        if check is not None:
            check(value, found.files.keys())
        return value
    except Exception as error:  # whatever a decoder raises in a check
        if not files.exists(path):
            return None
        reason = error.strerror if isinstance(error, OSError) else error
    warn(unusable(path, reason))
    files.remove(path)
    return None


def same_as(expected: T) -> Callable[[T, Collection[str]], None]:
    """A check that a note's value is this one."""

    def check(found: T, names: Collection[str]) -> None:
        if found != expected:
            raise ValueError("it was made of something else")

    return check


def unusable(path: Path, reason: object) -> str:
    """The warning about a piece of scratch that does not count."""
    return f"{path.name} of an earlier attempt can't be used ({printable(reason, 200)}); it is made again"


def once(warn: Warn) -> Warn:
    """Pass on the first warning alone: a power cut damages many pieces at a time."""
    warned = False

    def first(text: str) -> None:
        nonlocal warned
        if not warned:
            warned = True
            warn(text)

    return first


def _digest(value: Any, digests: dict[str, str]) -> str:
    return hashlib.sha256(json.dumps([value, digests]).encode()).hexdigest()


def digest_of(path: Path) -> str:
    """SHA-256 of a plain file. Raises OSError, for a link or a pipe too."""
    with opened(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def opened(path: Path) -> io.BufferedReader:
    """A plain file to read from. Raises OSError, for a link or a pipe too, which is not waited for."""
    return open(files.open_plain(path, follow=False), "rb")
