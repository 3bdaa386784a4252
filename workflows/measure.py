"""`enerf measure`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from pipeline.errors import BadInput, CorruptArtifact, UsageError
from stages.framing.true_frame import NAME, save_frame
from workflows.cli.options import common_options, folder_type, json_option, quiet_option, workflow
from workflows.cli.output import closing, listing, write_json
from workflows.cli.resolve import metres_of
from workflows.cli.target import open_run
from workflows.measuring import Measured, frame_by_lengths, in_words, measured, sides_in_words, sides_of, unit_in_words
from workflows.measuring import measure as measure_places
from workflows.report.page import NAME as REPORT
from workflows.report.page import write_report
from workflows.report.signature import VIEWER
from workflows.report.viewer import write_run_viewer


@click.command(context_settings={"ignore_unknown_options": True})  # places may begin with a minus
@click.argument("run", metavar="RUN", type=folder_type)
@click.argument("places", metavar="[PLACE]...", nargs=-1)
@click.option(
    "--known-length", "known", nargs=3, multiple=True, metavar="PLACE PLACE LENGTH",
    help="A length that you know, such as 0.30m, 30cm or 12in, between two places; may be repeated. Gives metres; replaces those given before.",
)
@click.option("--forget", is_flag=True, help="Go back to the capture's unit.")
@json_option
@quiet_option
@common_options
def measure(run: Path, places: tuple[str, ...], known: tuple[tuple[str, str, str], ...], forget: bool, as_json: bool, quiet: bool) -> None:
    """Measure the lengths from each PLACE to the next, with their errors, or without any the mesh: the sides of the upright box round it; or give RUN metres
    by lengths that you know.

    A PLACE is X,Y,Z as the viewer copies it, or one point's pixels in two photographs or more: a.jpg:120,340+b.jpg:98,310 (at full size, from the upper
    left corner). Nothing is trained again: with --known-length, exports, renders, pages and measures of RUN are in metres from then on. Files that the
    stages made stay in the capture's unit.
    """
    if len(places) == 1:
        raise UsageError("Give two places to measure between; or none, for the size of the mesh.")
    if forget and known:
        raise UsageError("--forget and --known-length: one of the two. New lengths replace those given before.")
    lengths = [(begin, end, metres_of(text, "--known-length")) for begin, end, text in known]
    summary: dict[str, Any] = {}
    if known or forget:
        opened = open_run(run)
        frame = None if forget else frame_by_lengths(_inside(run), run, lengths)
        with opened.locked():
            if frame is None:
                (run / NAME).unlink(missing_ok=True)
            else:
                save_frame(frame, run)
                summary["known_lengths"] = [{"from": each.begin, "to": each.end, "metres": each.metres, "residual": each.residual} for each in frame.lengths]
                summary |= {"metres_per_unit_of_capture": frame.from_capture.scale, "scale_error": frame.error}
            if (run / VIEWER).is_file():
                write_run_viewer(opened, anew=True)
            if (run / REPORT).is_file():
                write_report(opened, workflow().stages)
        if frame is not None and not as_json and not quiet:
            residuals = [f"  {each.metres:g} m: off by {each.residual:+.2%}" for each in frame.lengths] if len(lengths) > 1 else []
            closing(f"{run}: lengths in metres, within {frame.error:.2g} of each (99 %)", *residuals)
    if places:
        found = measure_places(measured(run), places)
        summary = found | summary
        if not as_json:
            listing(*in_words(found))
    elif not (known or forget):
        sides = sides_of(run)
        if sides is None:
            raise BadInput(f"{run}: has no mesh to measure. Give two places to measure between.")
        summary = sides
        if not as_json:
            listing(sides_in_words(sides), *unit_in_words(sides))
    if as_json:
        write_json({"event": "summary", "ok": True, "run": str(run), **summary, "exit_code": 0})


def _inside(run: Path) -> Measured:
    """What known lengths are given in: where the frame that was found before no longer fits, the capture's."""
    try:
        return measured(run)
    except (BadInput, CorruptArtifact):
        return measured(run, captured=True)
