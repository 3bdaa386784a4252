"""`enerf check`."""

from pathlib import Path

import click

from workflows.cli.options import folder_type, memory_limit, memory_option, output_options, set_option, workflow
from workflows.cli.output import conclude, listing
from workflows.inspection.check import check_source, in_words
from workflows.precompilation.start import start_alone


@click.command()
@click.argument("source", metavar="SOURCE", type=folder_type)
@click.option("--as", "format_name", metavar="FORMAT", help="Format of SOURCE, detected by default. See poses.format in 'enerf presets poses'.")
@set_option
@memory_option
@output_options
def check(source: Path, format_name: str | None, sets: tuple[str, ...], memory: str | None, as_json: bool, quiet: bool) -> int:
    """Check the photographs in the folder SOURCE, or frames of a video, before a run: sharpness, exposure, focal lengths, sizes, and overlap on small images.
    Report likely problems and what to do, and estimate the time and memory of camera poses and of a full run on this CPU.

    The grade is good, usable, poor or failed. The exit code is 0, or 2 if no cameras can be found.
    """
    start_alone()
    settings = ("poses.format=" + format_name,) if format_name else ()
    found = check_source(source, (*sets, *settings), memory_limit(memory), workflow())
    code = 2 if found["grade"] == "failed" else 0
    first, *others = in_words(found)
    conclude(first, as_json=as_json, code=code, **found)
    if not as_json and not quiet:
        listing(*others)
    return code
