"""Basic operations on files: atomic writes, bounded reads, canonical JSON, safe names.

What must survive a kill or a power cut goes through these functions and no others, so that tests can cut the power at each of them. `atomic` is the
one writer of files that appear whole or not at all. Nothing is written or deleted through a link, and nothing but plain files is opened.
"""

import contextlib
import errno
import json
import math
import os
import re
import secrets
import shutil
import stat
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

SafePoint = Callable[[], None]

MAX_JSON = 32 * 2**20  # bytes; a manifest of 100,000 files has about 15 MiB
MAX_DEPTH = 100  # of nested JSON; recursion over a value stays far from Python's limit

FULL_DISK_BYTES = 2**16  # bytes of a disk that is full

_CONTAINERS = 2**20  # lists and objects that a small file may hold; each takes about a hundred bytes of memory, and two in the file
_RANDOM = 8  # bytes; the names of temporary files cannot be guessed
# Names that `atomic` and `discard` give now, and those with a process's number that they gave before release 0.2.
_TEMPORARY = re.compile(r"\.(.+)\.(?:[0-9a-f]{16}|[0-9]{1,10})\.part", re.DOTALL)
_TRASH = re.compile(r"trash-(?:[0-9a-f]{16}|[0-9]{1,10}-[0-9]{1,20})")
_LONGEST = 200  # bytes of a file's name that its temporary's repeats: file systems allow 255
# Errors that speak of the file itself. All others are of the system, and say nothing about what was written.
_ERRORS_OF_THE_FILE = (errno.ELOOP, errno.EISDIR, errno.ENOTDIR, errno.EINVAL, errno.ENXIO, errno.ENAMETOOLONG, errno.ENOENT)
_KINDS = {
    stat.S_IFLNK: "a link",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFDIR: "a folder",
}


class Unreadable(ValueError):
    """A JSON file that is too large, cut off or not valid; the text says why."""

    def __init__(self, text: str, denied: OSError | None = None) -> None:
        super().__init__(text)
        self.denied = denied  # the error of the system where that would not read the file; see `is_denied`


def canonical_json(value: Any) -> bytes:
    """The one spelling of a plain value: keys sorted, no spaces, ASCII. Raises ValueError for NaN and infinity."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False).encode("ascii")


def pretty_json(value: Any, *, sort_keys: bool = True, default: Callable[[Any], Any] | None = None) -> bytes:
    """Indented JSON, for files that people read."""
    return json.dumps(value, indent=1, sort_keys=sort_keys, ensure_ascii=True, allow_nan=False, default=default).encode("ascii") + b"\n"


def is_denied(error: OSError) -> bool:
    """Whether the system would not read the file, whatever is in it: no permission, too many open files, no memory, a failing disk."""
    return error.errno not in _ERRORS_OF_THE_FILE


def kind_of(mode: int) -> str:
    """ "a link", "a pipe", "a device": what a file of this mode (st_mode) is."""
    return _KINDS.get(stat.S_IFMT(mode), "a plain file")


def open_plain(path: Path, *, follow: bool = True) -> int:
    """A descriptor of a plain file, to read from. Raises OSError; for a pipe, a device, a socket or a folder too, which are never opened.

    follow  whether `path` itself may be a link; not so for files of a run
    """
    _check_plain(path, os.stat(path, follow_symlinks=follow))  # before it is opened: opening a device may do something
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | (0 if follow else os.O_NOFOLLOW))
    try:
        _check_plain(path, os.fstat(descriptor))
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def _check_plain(path: Path, status: os.stat_result) -> None:
    if not stat.S_ISREG(status.st_mode):
        number = errno.EISDIR if stat.S_ISDIR(status.st_mode) else errno.ELOOP if stat.S_ISLNK(status.st_mode) else errno.EINVAL
        raise OSError(number, f"is {kind_of(status.st_mode)}, expected a plain file", str(path))


def read_json(path: Path, limit: int = MAX_JSON, *, follow: bool = True) -> Any:
    """The value in a plain file of at most `limit` bytes, finite and not deeply nested. Raises Unreadable; FileNotFoundError if there is none."""
    try:
        with open(open_plain(path, follow=follow), "rb") as file:
            size = os.fstat(file.fileno()).st_size
            data = b"" if size > limit else file.read(limit + 1)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise Unreadable(error.strerror or str(error), error if is_denied(error) else None) from None
    except ValueError as error:  # of a path with a NUL, or of characters that no file's name has
        raise Unreadable(str(error)) from None
    if max(size, len(data)) > limit:
        raise Unreadable(f"larger than {limit} bytes")
    if not data.strip():
        raise Unreadable("the file is empty")
    return json_value(data)


def json_value(data: bytes) -> Any:
    """The value of an untrusted JSON text, finite and not deeply nested. Raises Unreadable."""
    if data.count(b"[") + data.count(b"{") > _CONTAINERS + len(data) // 64:
        raise Unreadable("it holds too many lists and objects")
    try:
        value = json.loads(data, parse_constant=_refused)
        _check_values(value)
    except (ValueError, RecursionError) as error:  # UnicodeDecodeError is a ValueError
        text = str(error) if isinstance(error, ValueError) else "nested too deeply"
        raise Unreadable(f"not valid JSON ({text.splitlines()[0][:120]})") from None
    return value


def _check_values(value: Any) -> None:
    level = [value]
    for _ in range(MAX_DEPTH):
        below: list[Any] = []
        for item in level:
            if isinstance(item, dict):
                below.extend(item.values())
            elif isinstance(item, list):
                below.extend(item)
            elif isinstance(item, float) and not math.isfinite(item):
                _refused("1e999")
        if not below:
            return
        level = below
    raise ValueError("nested too deeply")


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
    with atomic_together([path], durable=durable) as (temporary,):
        yield temporary


@contextmanager
def atomic_together(paths: Sequence[Path], *, durable: bool = True) -> Iterator[list[Path]]:
    """As `atomic`, for files of one folder that belong together: none appears before all are written and synced, and the last one appears last.

    Where a rename fails, those that were not there before go again; files that were replaced by then stay replaced.
    """
    temporaries: list[Path] = []
    new: list[Path] = []
    try:
        for path in paths:
            temporaries.append(_created_beside(path))
        yield temporaries
        for temporary in temporaries if durable else ():
            sync_file(temporary)
        for temporary, path in zip(temporaries, paths, strict=True):
            if not exists(path):
                new.append(path)
            rename(temporary, path)
        if durable:
            sync_folder(paths[-1].parent)
    except BaseException as error:
        full = _disk_full_behind(error, paths[-1])
        for each in (*temporaries, *new):
            with contextlib.suppress(OSError):  # the error in flight is the one to report
                each.unlink(missing_ok=True)
        if full is not None:
            raise full from error
        raise


def _disk_full_behind(error: BaseException, path: Path) -> OSError | None:
    """The full-disk error, for a library that failed without an error number, while what it wrote still fills the disk."""
    if not isinstance(error, Exception) or (isinstance(error, OSError) and error.errno is not None):
        return None
    with contextlib.suppress(OSError):
        if shutil.disk_usage(path.parent).free < FULL_DISK_BYTES:
            return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
    return None


def _created_beside(path: Path) -> Path:
    """A new, empty file in the same folder: the next writer finds this file, not a link that somebody put there."""
    temporary = path.with_name(f".{_repeated(path.name)}.{secrets.token_hex(_RANDOM)}.part")
    os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666))
    return temporary


def _repeated(name: str) -> str:
    """As much of a file's name as fits into its temporary's."""
    while len(os.fsencode(name)) > _LONGEST:
        name = name[:-1]
    return name


def write_atomically(path: Path, data: bytes, *, durable: bool = True) -> None:
    """See `atomic`."""
    with atomic(path, durable=durable) as temporary:
        temporary.write_bytes(data)


def is_temporary(name: str, *of: str) -> bool:
    """Whether a file of this name is what a kill left of writing a file of one of these names; of any where none is given."""
    found = _TEMPORARY.fullmatch(name)
    return found is not None and (not of or found.group(1) in map(_repeated, of))


def remove_temporaries(folder: Path, *of: str, seconds: float = 0.0) -> None:
    """The plain files directly in a folder that kills left of writing files of these names, which no other process writes; or of any, last written longer
    ago than this. Raises OSError."""
    with os.scandir(folder) as entries:
        found = [entry for entry in entries if is_temporary(entry.name, *of) and entry.is_file(follow_symlinks=False)]
    for entry in found:
        with contextlib.suppress(FileNotFoundError):
            if not seconds or entry.stat(follow_symlinks=False).st_mtime < time.time() - seconds:
                os.unlink(entry.path)


def write_json(path: Path, value: Any, *, default: Callable[[Any], Any] | None = None) -> None:
    """An indented JSON file, written atomically; see `json.dumps`. Raises ValueError for NaN and infinity."""
    write_atomically(path, pretty_json(value, sort_keys=False, default=default))


def rename(source: Path, target: Path) -> None:
    """Atomic on one file system; a file at the target is replaced."""
    os.replace(source, target)


def link_or_copy(source: Path, target: Path) -> None:
    """A second name for a file that is never written in place, or a copy of it."""
    try:
        os.link(source, target, follow_symlinks=False)
    except FileNotFoundError:
        raise
    except (OSError, NotImplementedError):  # of another file system, of one or a system that has no links, of a file with too many
        shutil.copyfile(source, target, follow_symlinks=False)


def sync_folder(folder: Path) -> None:
    """Make renames within the folder, which may be given by a link, survive a power cut."""
    _sync(folder, os.O_DIRECTORY)


def sync_tree(folder: Path) -> None:
    """Every file and folder below, then the folder itself. Raises OSError for a link, or for what is no plain file."""
    for parent, _, names in os.walk(folder, topdown=False):
        for name in names:
            sync_file(Path(parent, name))
        sync_folder(Path(parent))


def sync_file(path: Path) -> None:
    """Raises OSError for a link."""
    _sync(path, os.O_NOFOLLOW | os.O_NONBLOCK)


def _sync(path: Path, flags: int) -> None:
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def remove(path: Path) -> None:
    """Remove anything, with all that is in it; of a link, the link and not its target."""
    if not is_folder(path):
        path.unlink(missing_ok=True)
        return
    try:
        shutil.rmtree(path)
    except RecursionError:
        raise OSError(errno.ENAMETOOLONG, "folders nested too deeply to be removed", str(path)) from None


def discard(path: Path, trash: Path) -> None:
    """Remove so that a kill never leaves a half-removed folder under the old name: it goes to the folder `trash` first."""
    if not os.path.lexists(path):
        return
    doomed = trash / f"trash-{secrets.token_hex(_RANDOM)}"
    rename(path, doomed)
    remove(doomed)


def is_trash(name: str) -> bool:
    """Whether a kill in `discard` may have left this name."""
    return _TRASH.fullmatch(name) is not None


def walk(folder: Path) -> Iterator[tuple[str, os.stat_result]]:
    """(relative posix name, lstat) of everything in the folder that is not itself a plain folder, sorted within each folder."""
    pending = [("", folder)]
    while pending:
        prefix, current = pending.pop()
        try:
            with os.scandir(current) as entries:
                found = sorted(entries, key=lambda entry: entry.name)
        except FileNotFoundError:
            if not prefix:
                raise
            continue  # as below
        for entry in found:
            if entry.is_dir(follow_symlinks=False):
                pending.append((f"{prefix}{entry.name}/", Path(entry.path)))
                continue
            with contextlib.suppress(FileNotFoundError):  # a reader takes no lock: a file may vanish under its eyes
                yield prefix + entry.name, os.stat(entry.path, follow_symlinks=False)


def is_folder(path: Path) -> bool:
    """Whether it is a folder, and no link to one."""
    try:
        return stat.S_ISDIR(os.lstat(path).st_mode)
    except (OSError, ValueError):
        return False


def exists(path: Path) -> bool:
    """Also for a link that points nowhere."""
    return os.path.lexists(path)


def is_empty(folder: Path) -> bool:
    with os.scandir(folder) as entries:
        return next(entries, None) is None
