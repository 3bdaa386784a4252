"""What `enerf check` tells of photographs before a run of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipeline.executors.memory import Limit
    from workflows.asset import Workflow

CPU_PRESET = "preview"  # as `enerf run` has it without CUDA


def check_source(source: Path, sets: Sequence[str], limit: Limit | None, workflow: Workflow) -> dict[str, Any]:
    """The verdict on a source as a document.

    sets   as of --set
    limit  of memory, that what is needed is compared with
    Raises BadInput, UsageError.
    """
    from pipeline.errors import BadInput
    from stages.sfm.colmap import num_threads
    from stages.verdict.preflight import check
    from workflows.cli.resolve import Settings, read_preset

    if not source.is_dir():
        raise BadInput(f"{source}: no such folder. Expected photographs, or a posed data set.")
    settings = Settings({stage.name: stage.settings for stage in workflow.stages})
    settings.put_table(read_preset(CPU_PRESET, workflow.presets).table, f"preset {CPU_PRESET}")
    for text in sets:
        settings.put_option(text)
    found = check(source, settings.resolved()["poses"], num_threads()).document()
    found["forecast"]["memory_limit"] = None if limit is None else limit.bytes
    found["forecast"]["fits"] = limit is None or found["forecast"]["poses_bytes"] <= limit.bytes
    return found


def in_words(found: dict[str, Any]) -> list[str]:
    """Lines of text: the grade first."""
    from pipeline.text import printable
    from workflows.cli.progress import duration, size

    about = found["forecast"]
    sizes = found["sizes"]
    what = f"{found['photographs']} photographs, {', '.join(sizes[:3])}{' ...' if len(sizes) > 3 else ''}, read as {found['format']}"
    lines = [printable(f"{found['source']}: {found['grade']}; {what}", 400)]
    for problem in found["problems"]:
        lines.append(printable(f"  {problem['sentence']} {problem['remedy']}", 600))
    if not found["problems"]:
        lines.append("  Nothing stands against them.")
    compared = f", {about['pairs']} pairs compared" if about["pairs"] else ""
    room = "" if about["fits"] else f", more than the {size(about['memory_limit'])} there are"
    seconds, memory = duration(about["poses_seconds"]), size(about["poses_bytes"])
    lines.append(f"  Cameras: about {seconds} on this machine if nothing else runs{compared}, and {memory} of memory{room}.")
    lines.append("  Then training, for as long as --budget says, or 'enerf presets' has it.")
    return lines
