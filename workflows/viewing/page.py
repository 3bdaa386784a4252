"""The viewer page of a run or of an asset file: the one that is there, or a new one."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from pipeline.errors import CorruptArtifact
from pipeline.run import cannot_write
from stages.viewer.page import NAME


def present_page(what: Path, asset: Path) -> Path | None:
    """The page that a run has of its present asset, or None."""
    from workflows.cli.target import is_run

    if not is_run(what):
        return None
    try:
        page, of = os.lstat(what / NAME), os.lstat(asset)
    except OSError:
        return None
    return what / NAME if stat.S_ISREG(page.st_mode) and page.st_size and page.st_mtime_ns >= of.st_mtime_ns else None


def make_page(what: Path, asset: Path, target: Path) -> None:
    """Write the page of a run's asset, with the cameras and photographs of the run, or of an asset file; whole or not at all.

    Raises CorruptArtifact for a damaged asset, DiskFull, and BadInput where it cannot be written.
    """
    from efficientnerf.asset.format import FormatError
    from stages.viewer.page import write_viewer
    from workflows.cli.target import is_run
    from workflows.report.viewer import captured

    cameras, photographs = captured(what) if is_run(what) else ([], {})
    try:
        write_viewer(asset, target, cameras=cameras, photographs=photographs, title=title_of(what, asset))
    except FormatError as error:
        raise CorruptArtifact(f"{asset}: {error}", (str(asset),)) from error
    except OSError as error:
        raise cannot_write(target, error) from error


def title_of(what: Path, asset: Path) -> str:
    """The name of the run, or of the file."""
    from workflows.cli.target import is_run

    return Path(os.path.abspath(what)).name if is_run(what) else asset.stem
