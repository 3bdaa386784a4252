"""`enerf status`."""

from pathlib import Path

import click

from pipeline.decide import survey
from pipeline.text import printable
from workflows.cli.options import common_options, folder_type, json_option, workflow
from workflows.cli.output import listing, write_json
from workflows.cli.progress import duration, size
from workflows.cli.target import open_run
from workflows.inspection.status import run_status


@click.command()
@click.argument("run_folder", metavar="RUN", type=folder_type)
@json_option
@common_options
def status(run_folder: Path, as_json: bool) -> None:
    """Show for each stage of RUN whether it is fresh, stale, missing, partial or corrupt, and why; with its time and size.

    Files with the same size and modification time count as unchanged; 'enerf verify' hashes them.
    """
    run = open_run(run_folder)
    found = run_status(run, survey(workflow().stages, run))
    if as_json:
        write_json(found, indent=1)
        return
    sources = ", ".join(map(str, run.sources.values())) or None
    listing(f"{run.path}  from {sources}  preset {run.preset}" if run.preset else f"{run.path}  from {sources}")
    for entry in found["stages"]:
        seconds = "" if entry["seconds"] is None else duration(entry["seconds"])
        count = "" if entry["bytes"] is None else size(entry["bytes"])
        line = f"{entry['name']:<10} {entry['state']:<8} {seconds:>13} {count:>8}  {entry['reason'] or entry['note'] or ''}"
        listing(line.rstrip())
        if entry["extra"]:
            listing(f"{'':<10} not written by it: {', '.join(entry['extra'][:5])}{' ...' if len(entry['extra']) > 5 else ''}")
    for name in ("verdict", "result"):
        if found[name] is not None:
            listing(printable(found[name]["summary"], 300))
    if found["written_by"] is not None:
        listing(f"It is being written by {found['written_by']}.")
