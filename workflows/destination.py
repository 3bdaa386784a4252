"""Files that a command is asked to write: outside of runs, not over inputs, and not over existing files unless forced.

Every file is written aside and renamed, so that it is complete or not there at all. What a rename would replace is a plain file or nothing: a link is
neither followed nor replaced, a pipe or a device (/dev/stdout) cannot be written so.
"""

import os
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from pipeline.errors import UsageError
from pipeline.run import NAME, cannot_write


def check_files(paths: Sequence[Path], *, force: bool, inputs: Sequence[Path] = ()) -> None:
    """Raise UsageError unless each of the files may be written.

    inputs  files that are read, and are no target even so
    """
    for number, path in enumerate(paths):
        folder = path.absolute().parent
        if not folder.is_dir():
            raise UsageError(f"{path}: the folder {path.parent} does not exist. Make it first.")
        check_outside_of_runs(path)
        check_free(path, force=force, inputs=inputs)
        if any(_resolved(path) == _resolved(other) for other in paths[:number]):
            raise UsageError(f"{path}: was given twice. Give each file once.")


def check_outside_of_runs(path: Path) -> None:
    """Raise UsageError for a file or folder in a run: whatever is in it, its stages alone write."""
    for place in (Path(os.path.abspath(path)), Path(os.path.realpath(path))):
        folder = next((each for each in (place, *place.parents) if os.path.lexists(each / NAME)), None)
        if folder is not None:
            raise UsageError(f"{path}: lies in the run {folder}, where its stages alone write. Give a place outside of it.")


def check_folder(path: Path) -> None:
    """Raise UsageError unless files may be written into this folder, which is created if it is missing."""
    if os.path.lexists(path) and not path.is_dir():
        raise UsageError(f"{path}: exists and is not a folder. Give a folder.")
    check_outside_of_runs(path)


@contextmanager
def writing(path: Path, *, force: bool) -> Iterator[None]:
    """While open, `path` is written. Raises UsageError if it came to exist meanwhile; OSError becomes BadInput or DiskFull that names it."""
    check_free(path, force=force)
    try:
        yield
    except OSError as error:
        raise cannot_write(path, error) from error


def check_free(path: Path, *, force: bool, inputs: Sequence[Path] = ()) -> None:
    """Raise UsageError where something is at `path` that may not be replaced; see `check_files`."""
    try:
        status = os.lstat(path)
    except FileNotFoundError:
        return
    if stat.S_ISDIR(status.st_mode):
        raise UsageError(f"{path}: is a folder. Give a file.")
    if stat.S_ISLNK(status.st_mode):
        raise UsageError(f"{path}: is a link, which is neither followed nor replaced. Give the file that it means, or remove the link.")
    if not stat.S_ISREG(status.st_mode):
        raise UsageError(f"{path}: is a pipe or a device; files are written aside and renamed. Give a plain file.")
    if any(each.is_file() and os.path.samefile(path, each) for each in inputs):
        raise UsageError(f"{path}: is the file that is read. Give another file.")
    if not force:
        raise UsageError(f"{path}: exists. Give another file, or --force to replace it.")


def _resolved(path: Path) -> Path:
    """Where a file of this name would lie: with the links on the way to it followed, not itself."""
    return Path(os.path.realpath(path.absolute().parent), path.name)
