"""The pages about a run: its report and its viewer, written once its stages are done."""

import os
from collections.abc import Sequence

from pipeline.run import NAME, Run
from pipeline.stage import Stage
from workflows.report.signature import PAGES, is_newer, is_own, viewer_is_missing


def write_pages(run: Run, stages: Sequence[Stage]) -> None:
    """Write them of what the run holds now."""
    from workflows.report.page import write_report  # torch, for the viewer: a run with nothing to do writes no page
    from workflows.report.viewer import write_run_viewer  # likewise

    write_run_viewer(run)
    write_report(run, stages)


def has_pages(run: Run, stages: Sequence[Stage]) -> bool:
    """Whether the report is there and no artifact was published after it nor a setting changed, no page is missing, and none is another's."""
    shown = (run.path / NAME, *(run.folder(stage.name) for stage in stages))
    written = [run.path / name for name in PAGES if os.path.lexists(run.path / name)]
    return is_newer(run.path / "report.html", shown) and not viewer_is_missing(run) and all(map(is_own, written))
