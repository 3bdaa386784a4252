"""From an exception of a stage, or of the system, to the error that is shown to the user."""

import errno
import shutil
from collections.abc import Iterator
from pathlib import Path

from pipeline.errors import BadInput, DiskFull, Interrupted, PipelineError, StageFailed
from pipeline.files import FULL_DISK_BYTES
from pipeline.text import printable

_FULL = (errno.ENOSPC, errno.EDQUOT)
_OF_THE_PATH = (
    errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOENT, errno.EEXIST, errno.EISDIR, errno.ENOTDIR, errno.ENOTEMPTY, errno.ELOOP, errno.EINVAL,
    errno.ENAMETOOLONG, errno.EXDEV, errno.ENXIO, errno.ENODEV, errno.ESPIPE, errno.EBUSY, errno.ETXTBSY,
)  # fmt: skip
_FULL_TEXTS = ("no space left on device", "disk quota exceeded", "disk is full", "disk full")  # of libraries that drop the number of the error


def history(error: BaseException) -> Iterator[BaseException]:
    """The error, what it was raised from, what was being handled then, and so on."""
    visited: set[int] = set()
    pending: list[BaseException | None] = [error]
    while pending:
        current = pending.pop()
        if current is None or id(current) in visited:
            continue
        visited.add(id(current))
        yield current
        pending += [current.__context__, current.__cause__]


def interruption_in(error: BaseException, signalled: int | None) -> Interrupted | None:
    """The interruption that a foreign library may have wrapped into an error of its own, on the way through a callback."""
    for cause in history(error):
        if isinstance(cause, Interrupted):
            return cause
        if isinstance(cause, KeyboardInterrupt):
            return Interrupted() if signalled is None else Interrupted(signalled)
    return None


def translated(error: BaseException, stage: str, run: Path) -> PipelineError:
    """A PipelineError stays as it is; a full disk, a lack of memory and everything else become one line about the stage."""
    full = _full_folder(error, run)
    if full is not None:
        return disk_full(full, stage)
    if isinstance(error, PipelineError):
        return error
    if is_bad_input(error):
        return BadInput(str(error))
    if any(isinstance(cause, MemoryError) for cause in history(error)):
        return StageFailed(f"{stage}: out of memory. Close other programs, or use a smaller preset or smaller images.")
    first = next((line.strip() for line in str(error).splitlines() if line.strip()), "")
    text = f"{type(error).__name__}: {first}" if first else type(error).__name__
    return StageFailed(f"{stage}: {text[:500]}")


def is_bad_input(error: BaseException) -> bool:
    """Whether the error's class says so by an attribute `bad_input`: packages that do not know the engine have such errors."""
    return getattr(error, "bad_input", False) is True


def _full_folder(error: BaseException, run: Path) -> Path | None:
    """The folder whose disk is full, if that is what happened."""
    for cause in history(error):
        if is_disk_full(cause):
            name = getattr(cause, "filename", None)
            return Path(name).absolute().parent if isinstance(name, str) else run
        if any(text in str(cause).lower() for text in _FULL_TEXTS):
            return run
    if not isinstance(error, PipelineError) and shutil.disk_usage(run).free < FULL_DISK_BYTES:
        return run  # a library that gave no reason
    return None


def is_disk_full(error: BaseException) -> bool:
    return isinstance(error, OSError) and error.errno in _FULL


def is_of_the_path(error: OSError) -> bool:
    """Whether the user can put it right at the path itself; everything else is of the disk or the system."""
    return error.errno in _OF_THE_PATH


def disk_full(folder: Path, what: str) -> DiskFull:
    """The error that names the disk that is full and the space left on it."""
    there = next((path for path in (folder, *folder.parents) if path.is_dir()), Path("/"))
    free = shutil.disk_usage(there).free / 2**20
    return DiskFull(f"{what}: no space (or quota) left in {there} ({free:.1f} MiB free). Free some space and go on; what was published before is not lost.")


def cannot_write(path: Path, error: OSError) -> BadInput | StageFailed:
    """For a file of a run that could not be written: DiskFull, StageFailed for a failing disk or system, else BadInput."""
    return _of_the_system(path, error, f"cannot be written ({printable(error.strerror or error, 200)}).")


def failed(path: Path, error: OSError) -> BadInput | StageFailed:
    """For a failure outside of a stage, while a run was read or put right: as `cannot_write`, naming the file."""
    where = f" at {printable(error.filename, 300)}" if isinstance(error.filename, str | bytes) else ""
    return _of_the_system(path, error, f"{printable(error.strerror or error, 200)}{where}. What was published before is not lost.")


def _of_the_system(path: Path, error: OSError, text: str) -> BadInput | StageFailed:
    if is_disk_full(error):
        return disk_full(path, str(path))
    return BadInput(f"{path}: {text}") if is_of_the_path(error) else StageFailed(f"{path}: {text}")
