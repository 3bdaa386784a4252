"""The viewer page of a run or of an asset file: the one that is there, if this program wrote it, or a new one."""

import os
from pathlib import Path

from efficientnerf.asset.format import FormatError
from pipeline.errors import CorruptArtifact
from pipeline.run import cannot_write
from stages.viewer.page import NAME, write_viewer
from workflows.cli.target import is_run, open_run
from workflows.report.signature import ASSET_VIEWER, VIEWER, viewers
from workflows.report.viewer import is_newest, write_viewer_of


def present_page(what: Path, asset: Path) -> Path | None:
    """The page that a run has of what it shows now, or None: one that another may have written is none."""
    if not is_run(what):
        return None
    try:
        page = os.lstat(what / NAME).st_mtime_ns
        if page < os.lstat(asset).st_mtime_ns:
            return None
    except OSError:
        return None
    return what / NAME if is_newest(open_run(what), what / NAME) else None


def make_page(what: Path, asset: Path, target: Path) -> None:
    """Write the page of a run, of its Gaussians or its asset, with its cameras and photographs; or that of an asset file; atomically.

    Raises CorruptArtifact for a damaged file, DiskFull, and BadInput where it cannot be written.
    """
    pages = viewers(open_run(what)) if is_run(what) else {}
    shown = pages.get(VIEWER, asset)
    try:
        if is_run(what):
            write_viewer_of(what, shown, target, ASSET_VIEWER if ASSET_VIEWER in pages and target == what / NAME else None)
        else:
            write_viewer(asset, target)
    except FormatError as error:
        raise CorruptArtifact(f"{shown}: {error}", (str(shown),)) from error
    except OSError as error:
        raise cannot_write(target, error) from error
