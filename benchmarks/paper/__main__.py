"""`python -m benchmarks.paper TABLE --out DIR`: a table of the paper, measured here."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from benchmarks.paper.document import Request, make
from pipeline.errors import PipelineError
from workflows.cli.device import resolve_device
from workflows.cli.options import device_option, folder_type
from workflows.cli.progress import display


@click.command()
@click.argument("table")
@click.option("--data", type=folder_type, help="Data set, or folder of data sets (table 7 needs none).")
@click.option("--out", required=True, type=folder_type, help="Folder of the table and its runs, which are resumed.")
@click.option("--scale", type=click.FloatRange(1e-5, 1.0), default=1.0, help="Scale of iterations, resolution, networks and grids.")
@device_option
def main(table: str, data: Path | None, out: Path, scale: float, device: str | None) -> None:
    """1 shares of samples, 2 quality and speed, 3 N1 to N4, 4 sizes of the networks, 5 modules one by one, 6 sampling strategies, 7 NerfTree against
    other structures. Writes table_N.md, .json and, if something is trained, .png.
    """
    with display(as_json=False, quiet=False) as show:
        try:
            written = make(table, Request(data, out, scale, resolve_device(device or "auto"), lambda text: show({"event": "message", "text": text}), show))
        except PipelineError as error:
            sys.exit(str(error))
    print(written["markdown"].read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
