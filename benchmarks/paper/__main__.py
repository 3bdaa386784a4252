"""`python -m benchmarks.paper`."""

import sys
from pathlib import Path

import click

from benchmarks.paper.document import Request, make
from workflows.cli.device import resolve_device
from workflows.cli.failures import report_failure
from workflows.cli.options import device_option, folder_type, output_options
from workflows.cli.output import closing, write_json
from workflows.cli.progress import display
from workflows.destination import check_folder


@click.command(context_settings={"max_content_width": 110})
@click.argument("table", metavar="TABLE")
@click.option("--data", type=folder_type, metavar="DIR", help="Data set, or folder of data sets (table 7 needs none).")
@click.option("--out", required=True, type=folder_type, metavar="DIR", help="Folder of the table and its runs, which are resumed.")
@click.option("--scale", type=click.FloatRange(1e-5, 1.0), default=1.0, show_default=True,
              help="Scale of iterations, resolution, networks and grids; the table reports it.")  # fmt: skip
@device_option
@output_options
def paper(table: str, data: Path | None, out: Path, scale: float, device: str | None, as_json: bool, quiet: bool) -> None:
    """Reproduce TABLE of the paper: 1 shares of samples, 2 quality and speed, 3 N1 to N4, 4 sizes of the networks, 5 modules one by one, 6 sampling
    strategies, 7 NerfTree against other structures. Writes DIR/table_N.md, .json and, if something is trained, .png.
    """
    check_folder(out)
    with display(as_json=as_json, quiet=quiet) as show:
        say = lambda text: show({"event": "message", "text": text})  # noqa: E731
        written = make(table, Request(data, out, scale, resolve_device(device or "auto"), say, show))
    if as_json:
        write_json({"event": "summary", "ok": True, "table": table, "files": {kind: str(path) for kind, path in written.items()}, "exit_code": 0})
    elif not quiet:
        closing(*written["markdown"].read_text(encoding="utf-8").split("\n"))


def main(arguments: list[str]) -> int:
    """The exit code, as `enerf` has them."""
    try:
        paper.main(args=arguments, prog_name="python -m benchmarks.paper", standalone_mode=False)
    except BaseException as error:
        return report_failure(error, as_json="--json" in arguments, debug=False)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
