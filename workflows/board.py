"""`enerf board`."""

from pathlib import Path

import click

from pipeline.errors import UsageError
from stages.figures.board import PAPERS, write_board
from workflows.cli.options import common_options, folder_type, force_option
from workflows.cli.output import closing
from workflows.cli.resolve import metres_of
from workflows.destination import check_files, writing


@click.command()
@click.option("--out", "path", required=True, type=folder_type, metavar="FILE", help="File to write, .pdf or .png.")
@click.option("--paper", type=click.Choice([*PAPERS]), default="a4", show_default=True, help="Size of the sheet.")
@click.option("--marker-size", metavar="LENGTH", default="50mm", show_default=True, help="Length of the markers' black edges, such as 50mm, 5cm or 2in.")
@force_option
@common_options
def board(path: Path, paper: str, marker_size: str, force: bool) -> None:
    """Write a sheet of markers to print. Photograph it next to the subject. `enerf run` with the same --marker-size gives lengths in metres."""
    if path.suffix.lower() not in (".pdf", ".png"):
        raise UsageError(f"--out {path}: expected a file that ends in .pdf or .png.")
    check_files([path], force=force)
    size = 1000 * metres_of(marker_size)
    if size < 10:
        raise UsageError(f"--marker-size {marker_size}: expected at least 10mm; smaller markers are not found in photographs.")
    with writing(path, force=force):
        write_board(path, paper, size)
    closing(f"{path}: print it at 100 %, and check the ruler.")
