"""`enerf report`."""

from pathlib import Path
from typing import Any

import click

from workflows.cli.options import common_options, folder_type, json_option, workflow
from workflows.cli.output import conclude
from workflows.cli.target import open_run
from workflows.report.page import write_report
from workflows.report.viewer import write_run_viewer


@click.command()
@click.argument("run_folder", metavar="RUN", type=folder_type)
@json_option
@common_options
def report(run_folder: Path, as_json: bool) -> None:
    """Write RUN/report.html: files, renders, metrics and settings of RUN; and RUN/viewer.html, which shows its 3D Gaussians in a
    browser, or its asset ('enerf run --viewer'). 'enerf run' writes both when it is done."""
    run = open_run(run_folder)
    viewer = write_run_viewer(run, anew=True)
    path = write_report(run, workflow().stages)
    shown: dict[str, Any] = {"report": str(path)} | ({} if viewer is None else {"viewer": str(viewer)})
    conclude(*shown.values(), as_json=as_json, run=str(run.path), **shown)
