"""RUN/viewer.html: the page that shows the run's asset in a browser. Like the report it belongs to no stage and can be made again."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from efficientnerf.asset.format import FormatError
from efficientnerf.geometry.cameras import Camera
from pipeline.errors import PipelineError
from pipeline.run import Run, cannot_write
from stages.artifacts import BakeOutputs, PosesOutputs, TrainOutputs
from stages.viewer.captured import captured_views
from stages.viewer.html import LARGEST
from stages.viewer.page import compact_bytes, viewer_page
from workflows.report.signature import VIEWER, is_own, size_of, write_page


def write_run_viewer(run: Run, *, anew: bool = False) -> Path | None:
    """Write RUN/viewer.html atomically, where it is missing, not this program's own or older than what it shows, or `anew`; returns its path.

    None, and no page, for a run without a sound asset, and for one whose asset is too large for a page that is made by itself. Raises DiskFull, and
    BadInput where the folder cannot be written.
    """
    path, asset = run.path / VIEWER, BakeOutputs.of_run(run.path).asset
    size = size_of(asset)
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


def write_viewer_of(run: Path, asset: Path, target: Path) -> None:
    """Write the page of a run's asset, signed. Raises FormatError and OSError."""
    cameras, photographs = captured(run)
    write_page(target, viewer_page(compact_bytes(asset), cameras=cameras, photographs=photographs, title=os.path.basename(os.path.abspath(run))))


def captured(run: Path) -> tuple[list[Camera], dict[str, bytes]]:
    """Cameras and photographs of the run in this folder, as `stages.viewer.page` takes them; none where they are missing or damaged."""
    with suppress(PipelineError):
        return captured_views(PosesOutputs.of_run(run).folder, TrainOutputs.of_run(run).folder)
    return [], {}


def _is_newest(run: Run, path: Path) -> bool:
    """Whether the page is our own, and none of the artifacts that it shows was published after it: that is a rename of its folder, which sets ctime."""
    try:
        status = os.stat(path, follow_symlinks=False)
        folders = [run.folder(stage) for stage in (BakeOutputs.stage, PosesOutputs.stage, TrainOutputs.stage)]
        changed = [os.stat(folder, follow_symlinks=False).st_ctime_ns for folder in folders if os.path.lexists(folder)]
    except OSError:
        return False
    return all(each <= status.st_mtime_ns for each in changed) and is_own(path)
