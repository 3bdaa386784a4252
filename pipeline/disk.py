"""What to raise where the system would not read or write: the disk is full, it is the user's to put right, or neither."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path

from pipeline.errors import BadInput, DiskFull, StageFailed
from pipeline.text import printable

_FULL = (errno.ENOSPC, errno.EDQUOT)
_BROKEN = (errno.EIO, errno.EMFILE, errno.ENFILE, errno.ENOMEM)  # nothing that other options or permissions would change


def is_disk_full(error: BaseException) -> bool:
    return isinstance(error, OSError) and error.errno in _FULL


def disk_full(folder: Path, what: str) -> DiskFull:
    """The error that names the disk that is full and the space left on it."""
    there = next((path for path in (folder, *folder.parents) if path.is_dir()), Path("/"))
    free = shutil.disk_usage(there).free / 2**20
    return DiskFull(f"{what}: no space (or quota) left in {there} ({free:.1f} MiB free). Make room and go on; what was published before is not lost.")


def cannot_write(path: Path, error: OSError) -> BadInput | StageFailed:
    """For a file of a run that could not be written: DiskFull, StageFailed for a failing disk or system, else BadInput."""
    if is_disk_full(error):
        return disk_full(path, str(path))
    text = f"{path}: cannot be written ({printable(error.strerror or error, 200)})."
    return StageFailed(text) if error.errno in _BROKEN else BadInput(text)


def failed(path: Path, error: OSError) -> BadInput | StageFailed:
    """For a failure outside of a stage, while a run was looked at or put right: as `cannot_write`, naming the file."""
    if is_disk_full(error):
        return disk_full(path, str(path))
    where = f" at {printable(error.filename, 300)}" if isinstance(error.filename, str | bytes) else ""
    text = f"{path}: {printable(error.strerror or error, 200)}{where}. What was published before is not lost."
    return StageFailed(text) if error.errno in _BROKEN else BadInput(text)
