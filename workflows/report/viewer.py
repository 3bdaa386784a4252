"""RUN/viewer.html: the page that shows the run's asset in a browser. Like the report it belongs to no stage and can be made again."""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from stages.artifacts import BakeOutputs, PosesOutputs, TrainOutputs

if TYPE_CHECKING:
    from efficientnerf.geometry.cameras import Camera
    from pipeline.run import Run

NAME = "viewer.html"


def write_run_viewer(run: Run, *, anew: bool = False) -> Path | None:
    """Write RUN/viewer.html atomically, where it is missing, not this program's own or older than what it shows, or `anew`; returns its path.

    None, and no page, for a run without a sound asset, and for one whose asset is too large for a page that is made by itself. Raises DiskFull, and
    BadInput where the folder cannot be written.
    """
    from efficientnerf.asset.format import FormatError
    from pipeline.run import cannot_write
    from stages.viewer.page import LARGEST

    path, asset = run.path / NAME, BakeOutputs.of_run(run.path).asset
    size = _size(asset)
    if size is not None and size <= LARGEST and not anew and _is_newest(run, path):
        return path
    try:
        if size is None or size > LARGEST:
            path.unlink(missing_ok=True)
            return None
        try:
            write_viewer_of(run.path, asset, path)
        except FormatError:  # `enerf verify` says what is wrong
            path.unlink(missing_ok=True)
            return None
    except OSError as error:
        raise cannot_write(path, error) from error
    return path


def is_missing(run: Run) -> bool:
    """Whether the run has no page though its asset is one that gets a page: it could not be read, or nobody has written the page yet."""
    from stages.viewer.page import LARGEST

    size = _size(BakeOutputs.of_run(run.path).asset)
    return size is not None and size <= LARGEST and not os.path.lexists(run.path / NAME)


def write_viewer_of(run: Path, asset: Path, target: Path) -> None:
    """Write the page of a run's asset, signed. Raises FormatError and OSError."""
    from stages.viewer.page import compact_bytes, viewer_page
    from workflows.report.signature import write_page

    cameras, photographs = captured(run)
    write_page(target, viewer_page(compact_bytes(asset), cameras=cameras, photographs=photographs, title=os.path.basename(os.path.abspath(run))))


def captured(run: Path) -> tuple[list[Camera], dict[str, bytes]]:
    """Cameras and photographs of the run in this folder, as `stages.viewer.page` takes them; none where they are missing or damaged."""
    from pipeline.errors import PipelineError
    from stages.viewer.captured import captured_views

    with suppress(PipelineError):
        return captured_views(PosesOutputs.of_run(run).folder, TrainOutputs.of_run(run).folder)
    return [], {}


def _size(path: Path) -> int | None:
    """Bytes of a plain file; None for anything else."""
    with suppress(OSError):
        status = os.stat(path, follow_symlinks=False)
        return status.st_size if stat.S_ISREG(status.st_mode) else None
    return None


def _is_newest(run: Run, path: Path) -> bool:
    """Whether the page is our own, and none of the artifacts that it shows was published after it: that is a rename of its folder, which sets ctime."""
    from workflows.report.signature import is_own

    try:
        status = os.stat(path, follow_symlinks=False)
        folders = [run.folder(stage) for stage in (BakeOutputs.stage, PosesOutputs.stage, TrainOutputs.stage)]
        changed = [os.stat(folder, follow_symlinks=False).st_ctime_ns for folder in folders if os.path.lexists(folder)]
    except OSError:
        return False
    return all(each <= status.st_mtime_ns for each in changed) and is_own(path)
