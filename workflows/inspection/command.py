"""`enerf check`."""

from __future__ import annotations

from pathlib import Path

import click

from workflows.cli.options import common_options, folder_type, json_option, memory_limit, memory_option, quiet_option, set_option, workflow
from workflows.cli.output import closing, listing, write_json
from workflows.inspection.check import check_source, in_words


@click.command()
@click.argument("source", metavar="SOURCE", type=folder_type)
@click.option("--as", "format_name", metavar="FORMAT", help="Format of SOURCE; by default it is detected. See poses.format in 'enerf presets poses'.")
@set_option
@memory_option
@json_option
@quiet_option
@common_options
def check(source: Path, format_name: str | None, sets: tuple[str, ...], memory: str | None, as_json: bool, quiet: bool) -> int:
    """Look at the photographs of the folder SOURCE, or at the frames that are chosen of a video: sharpness, exposure, focal lengths, sizes, overlap on
    small pictures; and say what is likely to go wrong, what to do, and what finding their cameras and a whole run will take here on the CPU.

    The grade is good, usable, poor or failed. Exit code 0, and 2 where no cameras can be found of them.
    """
    settings = ("poses.format=" + format_name,) if format_name else ()
    found = check_source(source, (*sets, *settings), memory_limit(memory), workflow())
    code = 2 if found["grade"] == "failed" else 0
    if as_json:
        write_json({"event": "summary", "ok": code == 0, **found, "exit_code": code})
    else:
        first, *others = in_words(found)
        closing(first)
        if not quiet:
            listing(*others)
    return code
