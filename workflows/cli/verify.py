"""`enerf verify`."""

from pathlib import Path
from typing import Any

import click

from pipeline.errors import CorruptArtifact
from pipeline.runner import verify as verify_run
from workflows.cli.failures import Reported
from workflows.cli.options import folder_type, output_options, workflow
from workflows.cli.output import conclude
from workflows.cli.progress import display, size
from workflows.cli.target import open_run
from workflows.report.signature import altered_pages


@click.command()
@click.argument("what", metavar="RUN|ASSET", type=folder_type)
@output_options
def verify(what: Path, as_json: bool, quiet: bool) -> None:
    """Compare the hash of every file of RUN, its pages included, with the recorded one; or check the hashes in ASSET and every rule of its format. The exit
    code is 4 if anything was altered.
    """
    if what.is_file():
        _verify_asset(what, as_json, quiet)
    else:
        _verify_run(what, as_json, quiet)


def _verify_asset(path: Path, as_json: bool, quiet: bool) -> None:
    from workflows.loading import describe_asset, load_asset  # a run is verified without reading its asset

    try:
        load_asset(path)
    except CorruptArtifact as error:
        raise Reported(error, {"asset": str(path), "damaged": list(error.files)}) from error
    about = describe_asset(path)
    facts: dict[str, Any] = {key: about[key] for key in ("format_version", "layout", "voxels", "bytes")}
    words = f"{path}: format {about['format_version']}, {about['layout']}, {about['voxels']} voxels, {size(path.stat().st_size)}, all as written"
    conclude(words, as_json=as_json, quiet=quiet, asset=str(path), **facts, damaged=[])


def _verify_run(run_folder: Path, as_json: bool, quiet: bool) -> None:
    run = open_run(run_folder)
    try:
        with display(as_json=as_json, quiet=quiet) as show:
            outcomes = verify_run(run, workflow().stages, show, altered=altered_pages(run.path))
    except CorruptArtifact as error:
        raise Reported(error, {"run": str(run.path), "damaged": list(error.files)}) from error
    words = f"{run.path}: {len(outcomes)} stages, {size(sum(each.size for each in outcomes))}, all as written"
    conclude(words, as_json=as_json, quiet=quiet, run=str(run.path), stages=[each.stage for each in outcomes], damaged=[])
