"""`enerf report`: the pages about a run, its report and its viewer, written once its stages are done."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from pipeline.run import NAME, Run
from pipeline.stage import Stage
from workflows.cli.options import common_options, folder_type, json_option, workflow
from workflows.cli.output import conclude
from workflows.cli.target import open_run
from workflows.report.signature import PAGES, is_newer, is_own, viewer_is_missing


@click.command()
@click.argument("run_folder", metavar="RUN", type=folder_type)
@json_option
@common_options
def report(run_folder: Path, as_json: bool) -> None:
    """Write RUN/report.html: files, renders, metrics and settings of RUN; and RUN/viewer.html, which shows its 3D Gaussians in a
    browser, or its asset ('enerf run --viewer'). 'enerf run' writes both when it is done."""
    run = open_run(run_folder)
    path, viewer = write_pages(run, workflow().stages, anew=True)
    shown: dict[str, Any] = {"report": str(path)} | ({} if viewer is None else {"viewer": str(viewer)})
    conclude(*shown.values(), as_json=as_json, run=str(run.path), **shown)


def write_pages(run: Run, stages: Sequence[Stage], *, anew: bool = False) -> tuple[Path, Path | None]:
    """Write them of what the run holds now, the viewer where it is out of date or `anew`; the paths of both, None where there is no viewer."""
    from workflows.report.page import write_report  # torch, for the viewer: a run with nothing to do writes no page
    from workflows.report.viewer import write_run_viewer  # likewise

    viewer = write_run_viewer(run, anew=anew)
    return write_report(run, stages), viewer


def has_pages(run: Run, stages: Sequence[Stage]) -> bool:
    """Whether the report is there and no artifact was published after it nor a setting changed, no page is missing, and none is another's."""
    shown = (run.path / NAME, *(run.folder(stage.name) for stage in stages))
    written = [run.path / name for name in PAGES if os.path.lexists(run.path / name)]
    return is_newer(run.path / "report.html", shown) and not viewer_is_missing(run) and all(map(is_own, written))
