"""The few operations on files that everything else is made of: atomic writes, bounded reads, canonical JSON, safe names.

What must survive a kill or a power cut goes through these functions and no others, so that tests can cut the power at each of them. `atomic` is the
one writer of files that appear whole or not at all.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

SafePoint = Callable[[], None]

MAX_JSON = 64 * 2**20  # bytes; a manifest of 100,000 files has about 15 MiB


class Unreadable(ValueError):
    """A JSON file that is too large, cut off or not valid; the text says why."""


def canonical_json(value: Any) -> bytes:
    """The one spelling of a plain value: keys sorted, no spaces, ASCII. Raises ValueError for NaN and infinity."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False).encode("ascii")


def pretty_json(value: Any, *, sort_keys: bool = True, default: Callable[[Any], Any] | None = None) -> bytes:
    """Indented JSON, for files that people read."""
    return json.dumps(value, indent=1, sort_keys=sort_keys, ensure_ascii=True, allow_nan=False, default=default).encode("ascii") + b"\n"


def read_json(path: Path, limit: int = MAX_JSON) -> Any:
    """The value in a file of at most `limit` bytes. Raises Unreadable; FileNotFoundError if there is none."""
    try:
        with open(path, "rb") as file:
            data = file.read(limit + 1)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise Unreadable(error.strerror or str(error)) from None
    if len(data) > limit:
        raise Unreadable(f"larger than {limit} bytes")
    if not data.strip():
        raise Unreadable("the file is empty")
    try:
        return json.loads(data, parse_constant=_refused)
    except (ValueError, RecursionError) as error:  # UnicodeDecodeError is a ValueError
        text = str(error) if isinstance(error, ValueError) else "nested too deeply"
        raise Unreadable(f"not valid JSON ({text.splitlines()[0][:120]})") from None


def _refused(name: str) -> Any:
    raise ValueError(f"{name} is no number")


def is_safe_name(name: str) -> bool:
    """Whether a relative posix path stays where it is put: not absolute, no "..", no empty part, no NUL."""
    if not name or "\0" in name or name != str(PurePosixPath(name)):
        return False
    path = PurePosixPath(name)
    return bool(path.parts) and not path.is_absolute() and ".." not in path.parts


@contextmanager
def atomic(path: Path, *, durable: bool = True) -> Iterator[Path]:
    """A temporary path in the same folder to write to, renamed to `path` when the block ends and removed when it raises.

    durable  sync the file before and the folder after the rename: the file has its old content or all of the new after a power cut, too.
             Without, only a kill is survived: for scratch that is checked when it is read, or made again
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield temporary
        if durable:
            sync_file(temporary)
        rename(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    if durable:
        sync_folder(path.parent)


def write_atomically(path: Path, data: bytes, *, durable: bool = True) -> None:
    """See `atomic`."""
    with atomic(path, durable=durable) as temporary:
        temporary.write_bytes(data)


def is_temporary(name: str, path: str) -> bool:
    """Whether a file of this name is what a kill left of writing `path`."""
    return name.startswith(f".{path}.") and name.endswith(".part")


def remove_temporaries(path: Path) -> None:
    """What kills left of writing `path`; only while no other process writes it."""
    for entry in list(path.parent.iterdir()):
        if is_temporary(entry.name, path.name):
            entry.unlink(missing_ok=True)


def write_json(path: Path, value: Any, *, sort_keys: bool = False, default: Callable[[Any], Any] | None = None, durable: bool = True) -> None:
    """An indented JSON file, written atomically; see `json.dumps`. Raises ValueError for NaN and infinity."""
    write_atomically(path, pretty_json(value, sort_keys=sort_keys, default=default), durable=durable)


def rename(source: Path, target: Path) -> None:
    """Atomic on one file system; a file at the target is replaced."""
    os.replace(source, target)


def sync_folder(folder: Path) -> None:
    """Make renames within the folder survive a power cut."""
    _sync(folder, os.O_DIRECTORY)


def sync_tree(folder: Path) -> None:
    """Every file and folder below, then the folder itself."""
    for parent, _, names in os.walk(folder, topdown=False):
        for name in names:
            sync_file(Path(parent, name))
        sync_folder(Path(parent))


def sync_file(path: Path) -> None:
    _sync(path, os.O_NOFOLLOW)


def _sync(path: Path, flags: int) -> None:
    descriptor = os.open(path, os.O_RDONLY | flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def remove(path: Path) -> None:
    """Whatever it is, with all that is in it; a link goes, not what it points to."""
    if path.is_symlink() or not path.is_dir():
        path.unlink(missing_ok=True)
    else:
        shutil.rmtree(path)


def discard(path: Path, trash: Path) -> None:
    """Remove so that a kill never leaves a half-removed folder under the old name: it goes to the folder `trash` first."""
    if not os.path.lexists(path):
        return
    doomed = trash / f"trash-{os.getpid()}-{time.time_ns()}"
    rename(path, doomed)
    remove(doomed)


def walk(folder: Path) -> Iterator[tuple[str, os.stat_result]]:
    """(relative posix name, lstat) of everything in the folder that is not itself a plain folder, sorted within each folder."""
    pending = [("", folder)]
    while pending:
        prefix, current = pending.pop()
        with os.scandir(current) as entries:
            found = sorted(entries, key=lambda entry: entry.name)
        for entry in found:
            if entry.is_dir(follow_symlinks=False):
                pending.append((f"{prefix}{entry.name}/", Path(entry.path)))
                continue
            with contextlib.suppress(FileNotFoundError):  # a reader takes no lock: a file may vanish under its eyes
                yield prefix + entry.name, os.stat(entry.path, follow_symlinks=False)


def exists(path: Path) -> bool:
    """Also for a link that points nowhere."""
    return os.path.lexists(path)


def is_empty(folder: Path) -> bool:
    with os.scandir(folder) as entries:
        return next(entries, None) is None
