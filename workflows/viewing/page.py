"""The viewer page of a run or of an asset file: the one that is there, if this program wrote it, or a new one."""

from __future__ import annotations

import os
from pathlib import Path

from efficientnerf.asset.format import FormatError
from pipeline.errors import CorruptArtifact
from pipeline.run import cannot_write
from stages.viewer.page import NAME, write_viewer
from workflows.cli.target import is_run, open_run
from workflows.report.signature import VIEWER, is_own, viewers
from workflows.report.viewer import write_viewer_of


def present_page(what: Path, asset: Path) -> Path | None:
    """The page that a run has of its present asset, or None: one that another may have written is none."""
    if not is_run(what):
        return None
    try:
        page, of = os.lstat(what / NAME), os.lstat(asset)
    except OSError:
        return None
    return what / NAME if page.st_mtime_ns >= of.st_mtime_ns and is_own(what / NAME) else None


def make_page(what: Path, asset: Path, target: Path) -> None:
    """Write the page of a run, of its Gaussians or its asset, with its cameras and photographs; or that of an asset file; atomically.

    Raises CorruptArtifact for a damaged asset, DiskFull, and BadInput where it cannot be written.
    """
    try:
        if is_run(what):
            write_viewer_of(what, viewers(open_run(what)).get(VIEWER, asset), target)
        else:
            write_viewer(asset, target)
    except FormatError as error:
        raise CorruptArtifact(f"{asset}: {error}", (str(asset),)) from error
    except OSError as error:
        raise cannot_write(target, error) from error
