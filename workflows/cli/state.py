"""`enerf check`, `enerf status`, `enerf verify` and `enerf report`."""

from __future__ import annotations

from pathlib import Path

import click

from workflows.cli.options import common_options, folder_type, json_option, memory_limit, memory_option, quiet_option, set_option, workflow


@click.command(short_help="Say whether photographs will do, before anything is run.")
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
    from workflows.cli.output import closing, listing, write_json
    from workflows.inspection.check import check_source, in_words

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


@click.command(short_help="Show for each stage whether it is up to date, and why not.")
@click.argument("run_folder", metavar="RUN", type=folder_type)
@json_option
@common_options
def status(run_folder: Path, as_json: bool) -> None:
    """Show for each stage of RUN whether it is fresh, stale, missing, partial or corrupt, with the reason, its seconds and its size.

    A file of unchanged size and modification time counts as unchanged; 'enerf verify' hashes it.
    """
    from pipeline.decide import survey
    from pipeline.text import printable
    from workflows.cli.output import listing, write_json
    from workflows.cli.progress import duration, size
    from workflows.cli.target import open_run
    from workflows.inspection.status import run_status

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


@click.command(short_help="Check every file against its recorded hash.")
@click.argument("what", metavar="RUN|ASSET", type=folder_type)
@json_option
@quiet_option
@common_options
def verify(what: Path, as_json: bool, quiet: bool) -> None:
    """Hash every file of RUN, its pages too, and compare it with the recorded hashes; or read ASSET, which carries its own hashes, and check every rule of its
    format. Exit code 4 if anything was altered.
    """
    if what.is_file():
        _verify_asset(what, as_json, quiet)
    else:
        _verify_run(what, as_json, quiet)


def _verify_asset(path: Path, as_json: bool, quiet: bool) -> None:
    from pipeline.errors import CorruptArtifact
    from workflows.cli.failures import Reported
    from workflows.cli.output import closing, write_json
    from workflows.cli.progress import size
    from workflows.cli.target import describe_asset, load_asset

    try:
        load_asset(path)
    except CorruptArtifact as error:
        raise Reported(error, {"asset": str(path), "damaged": list(error.files)}) from error
    about = describe_asset(path)
    if as_json:
        facts = {key: about[key] for key in ("format_version", "layout", "voxels", "bytes")}
        write_json({"event": "summary", "ok": True, "asset": str(path), **facts, "damaged": [], "exit_code": 0})
    elif not quiet:
        closing(f"{path}: format {about['format_version']}, {about['layout']}, {about['voxels']} voxels, {size(path.stat().st_size)}, all as written")


def _verify_run(run_folder: Path, as_json: bool, quiet: bool) -> None:
    from pipeline.errors import CorruptArtifact
    from pipeline.runner import verify as verify_run
    from workflows.cli.failures import Reported
    from workflows.cli.output import closing, write_json
    from workflows.cli.progress import display, size
    from workflows.cli.target import open_run
    from workflows.report.signature import altered_pages

    run = open_run(run_folder)
    try:
        with display(as_json=as_json, quiet=quiet) as show:
            outcomes = verify_run(run, workflow().stages, show, altered=altered_pages(run.path))
    except CorruptArtifact as error:
        raise Reported(error, {"run": str(run.path), "damaged": list(error.files)}) from error
    if as_json:
        write_json({"event": "summary", "ok": True, "run": str(run.path), "stages": [each.stage for each in outcomes], "damaged": [], "exit_code": 0})
    elif not quiet:
        total = sum(each.size for each in outcomes)
        closing(f"{run.path}: {len(outcomes)} stages, {size(total)}, all as written")


@click.command(short_help="Write a page about a run: renders, figures, settings.")
@click.argument("run_folder", metavar="RUN", type=folder_type)
@json_option
@common_options
def report(run_folder: Path, as_json: bool) -> None:
    """Write RUN/report.html: files, renders, metrics and settings of RUN; and RUN/viewer.html, which shows its asset in a browser. 'enerf run' writes
    both when it is done."""
    from workflows.cli.output import closing, write_json
    from workflows.cli.target import open_run
    from workflows.report.page import write_report
    from workflows.report.viewer import write_run_viewer

    run = open_run(run_folder)
    viewer = write_run_viewer(run, anew=True)
    path = write_report(run, workflow().stages)
    if as_json:
        shown = {} if viewer is None else {"viewer": str(viewer)}
        write_json({"event": "summary", "ok": True, "run": str(run.path), "report": str(path), **shown, "exit_code": 0})
    else:
        closing(str(path), *([] if viewer is None else [str(viewer)]))
