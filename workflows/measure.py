"""`enerf measure` and `enerf orient`."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import numpy as np

from pipeline.errors import BadInput, CorruptArtifact, UsageError
from pipeline.run import Run
from stages.framing.true_frame import AS_CAPTURED, NAME, TrueFrame, load_frame, save_frame
from workflows import measuring
from workflows.cli.options import folder_type, output_options, workflow
from workflows.cli.output import closing, conclude, listing
from workflows.cli.resolve import metres_of
from workflows.cli.target import open_run
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
@output_options
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
        frame = _found(run).with_lengths(1.0, None, ()) if forget else measuring.frame_by_lengths(_inside(run), run, lengths)
        _keep(opened, frame)
        if known:
            summary["known_lengths"] = [{"from": each.begin, "to": each.end, "metres": each.metres, "residual": each.residual} for each in frame.lengths]
            summary |= {"metres_per_unit_of_capture": frame.from_capture.scale, "scale_error": frame.error}
        if known and not as_json and not quiet:
            residuals = [f"  {each.metres:g} m: off by {each.residual:+.2%}" for each in frame.lengths] if len(lengths) > 1 else []
            closing(f"{run}: lengths in metres, within {frame.error:.2g} of each (99 %)", *residuals)
    if places:
        found = measuring.measure(measuring.measured(run), places)
        summary = found | summary
        if not as_json:
            listing(*measuring.in_words(found))
    elif not (known or forget):
        sides = measuring.sides_of(run, measuring.measured(run))
        if sides is None:
            raise BadInput(f"{run}: has no mesh to measure. Give two places to measure between.")
        summary = sides
        if not as_json:
            listing(measuring.sides_in_words(sides), *measuring.unit_in_words(sides))
    conclude(as_json=as_json, quiet=True, run=str(run), **summary)


@click.command(context_settings={"ignore_unknown_options": True})  # places may begin with a minus
@click.argument("run", metavar="RUN", type=folder_type)
@click.argument("places", metavar="[PLACE PLACE PLACE]", nargs=-1)
@click.option("--up", metavar="X,Y,Z", help="The direction that is up, in the frame of RUN's exports, instead of places. The ground is what is level under it.")
@click.option("--plane", is_flag=True, help="The floor or table that the sparse points show, instead of places.")
@click.option("--forget", is_flag=True, help="Go back to the up that RUN found.")
@output_options
def orient(run: Path, places: tuple[str, ...], up: str | None, plane: bool, forget: bool, as_json: bool, quiet: bool) -> None:
    """Set which way is up in a finished RUN, and where the ground is, by three PLACEs on it (as of `enerf measure`), far apart and not in a row; the cameras
    are above it.

    Nothing is trained again. From then on exports of RUN (meshes, points, Gaussians, volumes, cameras, assets) have z up, or y up where the format has it so,
    and 0 on the ground; places and sizes of `enerf measure`, the report, the viewer's pages and the turntables of `enerf render` follow. Lengths stay. Files
    that the stages made, the run's own turntable among them, keep the up that RUN found.
    """
    if (len(places) > 0) + (up is not None) + plane + forget != 1 or len(places) not in (0, 3):
        raise UsageError("Give three places on the ground, or --plane, or --up X,Y,Z, or --forget.")
    opened = open_run(run)
    if forget:
        _keep(opened, _found(run).with_ground(None))
        conclude(as_json=as_json, quiet=True, run=str(run))
        return
    inside = measuring.measured(run)
    error = None
    if places:
        ground, error = measuring.ground_through(inside, places)
    else:
        ground = measuring.ground_found(inside, run) if up is None else measuring.ground_of(inside, run, up)
    angle, (words, known) = float(np.degrees(np.arccos(np.clip(inside.own_up @ ground.up, -1, 1)))), measuring.up_from(run)
    inside = replace(inside, true=inside.true.with_ground(ground))
    _keep(opened, inside.true)
    said = f"{angle:.1f} degrees from the up that the run has, which is {words}"
    conflict = known and angle > max(error or 0.0, measuring.UPRIGHT)
    if conflict:
        print(f"warning: the new up is {said}.", file=sys.stderr)
    facts: dict[str, Any] = {"up": list(ground.up), "up_error": error, "ground": ground.height, "degrees_from_run": angle, "up_of_run": words}
    again = measuring.how_to_turn_upright(run, inside)
    lines = [f"{run}: up is set{'' if error is None else f', within {error:.2g} degrees (99 %)'}{'' if conflict else f'; {said}'}"]
    lines += [f"  its turntable keeps the former up; upright: {again}"] if again else []
    conclude(*lines, as_json=as_json, quiet=quiet, run=str(run), **facts)


def _keep(opened: Run, frame: TrueFrame) -> None:
    """Keep the frame, none where it is the capture's, and write the pages again that show it."""
    with opened.locked():
        if frame.error is None and frame.ground is None:
            (opened.path / NAME).unlink(missing_ok=True)
        else:
            save_frame(frame, opened.path)
        if (opened.path / VIEWER).is_file():
            write_run_viewer(opened, anew=True)
        if (opened.path / REPORT).is_file():
            write_report(opened, workflow().stages)


def _found(run: Path) -> TrueFrame:
    """The frame that was found before; the capture's where there is none that can be used."""
    try:
        return load_frame(run) or AS_CAPTURED
    except (BadInput, CorruptArtifact):
        return AS_CAPTURED


def _inside(run: Path) -> measuring.Measured:
    """What known lengths are given in: where the frame that was found before no longer fits, the capture's."""
    try:
        return measuring.measured(run)
    except (BadInput, CorruptArtifact):
        return measuring.measured(run, captured=True)
