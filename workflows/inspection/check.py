"""`enerf check`: the verdict on photographs before a run."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click

from pipeline.errors import BadInput
from pipeline.executors.memory import Limit
from pipeline.text import printable
from stages.cores import count_cores
from stages.formats.importers import formats_of
from stages.io.material import find_material
from stages.verdict import preflight
from stages.verdict.verdict import plural
from stages.video.frames import Reader, frames_of
from stages.video.reading import UnreadableVideo
from workflows.cli.options import folder_type, memory_limit, memory_option, output_options, set_option, workflow
from workflows.cli.output import conclude, listing
from workflows.cli.progress import duration, size
from workflows.cli.resolve import Settings, read_preset
from workflows.precompilation.start import start_alone
from workflows.workflow import Workflow

CPU_PRESET = "preview"  # as `enerf run` has it without CUDA
STANDING = {  # of a video of which a run would keep hardly a frame
    "sentence": "Hardly a frame of the video differs from the others: the camera stands still, or all is dark.",
    "remedy": "Walk round the subject while filming, slowly, in good light.",
}


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


def check_source(source: Path, sets: Sequence[str], limit: Limit | None, workflow: Workflow) -> dict[str, Any]:
    """The verdict on a source as a document.

    limit  of memory, that what is needed is compared with
    Raises BadInput, UsageError.
    """
    if not source.exists():
        raise BadInput(f"{source}: no such folder or file. Expected photographs, a video, or a posed data set.")
    settings = Settings(workflow.settings)
    settings.put_table(read_preset(CPU_PRESET, workflow.presets).table, f"preset {CPU_PRESET}")
    for text in sets:
        settings.put_option(text)
    stages = settings.resolved()
    poses = stages["poses"]
    with TemporaryDirectory() as work:
        folder = with_frames_for_videos(source, poses, Path(work))
        found = preflight.check(folder, poses, count_cores(), stages).document() | {"source": str(source)}
        if folder != source:
            found["problems"] = [each | STANDING if (each["what"], each["grade"]) == ("few", "failed") else each for each in found["problems"]]
    found["forecast"]["memory_limit"] = None if limit is None else limit.bytes
    found["forecast"]["fits"] = limit is None or found["forecast"]["run_bytes"] <= limit.bytes
    return found


def with_frames_for_videos(source: Path, poses: Any, work: Path) -> Path:
    """The folder itself; for a video, or a folder of videos, one with the frames that a run would choose. Raises BadInput."""
    if formats_of(source, poses)[0] != "photographs":
        return source
    videos = find_material({"": source}, poses.allow_outside, _nothing).videos
    if not videos:
        return source
    try:
        frames_of(videos, count=poses.frames, max_side=poses.feature_image_size, reader=Reader(count_cores(), work, _nothing, _nothing, _nothing))
    except UnreadableVideo as error:
        raise BadInput(f"{source}: {error}. Copy or export the video again.") from error
    return work


def _nothing(*values: object) -> None:
    """Takes progress and warnings, and drops them."""


def in_words(found: dict[str, Any]) -> list[str]:
    """Lines of text: the grade first."""
    about = found["forecast"]
    sizes = found["sizes"]
    count = f"{found['photographs']} {plural(found['photographs'], 'photographs', 'photograph')}"
    what = f"{count}, {', '.join(sizes[:3])}{' ...' if len(sizes) > 3 else ''}, read as {found['format']}"
    what += f"; {found['looked_at']} of them were checked" if found["looked_at"] < found["photographs"] else ""
    lines = [printable(f"{found['source']}: {found['grade']}; {what}", 400)]
    for problem in found["problems"]:
        lines.append(printable(f"  {problem['sentence']} {problem['remedy']}", 600))
    if not found["problems"]:
        lines.append("  No problems found.")
    lines += [printable(f"  {sentence}", 600) for sentence in found["left_aside"]]
    if found["grade"] == "failed":
        return [*lines, "  A run would end without cameras."]
    compared = f", {about['pairs']} pairs compared" if about["pairs"] else ""
    seconds, memory = duration(about["poses_seconds"]), size(about["poses_bytes"])
    lines.append(f"  Cameras: about {seconds} on this machine if nothing else runs{compared}, and {memory} of memory.")
    lines.append(f"  {_of_the_run(about)}")
    return lines


def _of_the_run(about: dict[str, Any]) -> str:
    excess = "" if about["fits"] else f", more than the {size(about['memory_limit'])} available; lower --target-mib"
    memory = f"up to about {size(about['run_bytes'])} of memory{excess}"
    if about["run_seconds"] is None:
        return f"Then training, for the time set by --budget or the preset; {memory}."
    longest = sorted(about["stage_seconds"].items(), key=lambda stage: -stage[1])[:3]
    stages = ", ".join(f"{name} {duration(took)}" for name, took in longest)
    return f"All stages of the preset {CPU_PRESET}: about {duration(about['run_seconds'])} ({stages}), and {memory}."
