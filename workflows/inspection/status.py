"""`enerf status`: the states of a run's stages, as the live page reports them, too."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from pipeline.decide import Decision, survey
from pipeline.locks.lock import holder_of
from pipeline.run import Run
from pipeline.text import printable
from stages.artifacts import EvaluateOutputs, PosesOutputs
from workflows.cli.options import common_options, folder_type, json_option, workflow
from workflows.cli.output import listing, write_json
from workflows.cli.progress import duration, size
from workflows.cli.target import open_run
from workflows.report.documents import Verdict, sound


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


def run_status(run: Run, decisions: Sequence[Decision]) -> dict[str, Any]:
    """A run, who is writing it, and its stages."""
    holder = holder_of(run.path)
    facts: dict[str, Any] = {"run": str(run.path), "source": run.source, "also": run.also, "preset": run.preset, "seed": run.seed, "device": run.device}
    facts |= {"verdict": camera_verdict(run.path), "result": result_verdict(run.path), "written_by": None if holder is None else holder.text()}
    return {**facts, "stages": [_stage(each) for each in decisions]}


def camera_verdict(run: Path) -> dict[str, Any] | None:
    """The grade of the cameras and a sentence; None where there are none yet, or they say nothing that can be read."""
    return _verdict(PosesOutputs.of_run(run).verdict)


def result_verdict(run: Path) -> dict[str, Any] | None:
    """The same of what was made."""
    return _verdict(EvaluateOutputs.of_run(run).verdict)


def _verdict(path: Path) -> dict[str, Any] | None:
    found = sound(path, Verdict)
    return None if found is None else {"grade": found[0].grade, "summary": found[0].summary}


def _stage(decision: Decision) -> dict[str, Any]:
    made = decision.manifest
    return {
        "name": decision.stage,
        "state": decision.state,
        "reason": decision.reason,
        "note": decision.note,
        "seconds": None if made is None else made.seconds,
        "bytes": None if made is None else made.size,
        "peak_memory": None if made is None else made.peak_memory,
        "digest": None if made is None else made.digest,
        "extra": list(decision.extra),
    }
