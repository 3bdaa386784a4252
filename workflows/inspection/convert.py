"""Conversion of asset files."""

import hashlib
from pathlib import Path
from typing import Any

from efficientnerf.asset import conversion, format
from efficientnerf.asset.file.metadata import layout_of
from pipeline.errors import UsageError
from workflows.cli.target import asset_of
from workflows.loading import load_asset


def convert(what: Path, out: Path, layout: str | None, degree: int | None, resolution: int | None) -> None:
    """Write the asset of `what` (a run or an asset) to `out`, atomically; None keeps the value of the source.

    Raises UsageError for a degree or a resolution above its own and for a layout that it has no place in (FORMAT.md, section 10), BadInput and
    CorruptArtifact as `load_asset`.
    """
    source = asset_of(what)
    tree = load_asset(what)
    about = format.describe(source)
    if layout is None:
        layout = writer_of(about)
    if layout_of(about) == "full" and not layout.startswith("full"):
        tree = conversion.pruned(tree)
    try:
        if degree is not None:
            tree = conversion.with_degree(tree, degree)
        if resolution is not None:
            tree = conversion.pruned(conversion.with_resolution(tree, resolution))
    except ValueError as error:
        raise UsageError(f"{source}: {error}") from error
    made_from = {"sha256": hashlib.sha256(source.read_bytes()).hexdigest(), **{key: about[key] for key in ("layout", "resolution", "sh_degree")}}
    provenance = tree.metadata.get("provenance")
    tree = tree.with_metadata(provenance={**(provenance if isinstance(provenance, dict) else {}), "converted_from": made_from})
    try:
        format.save(tree, out, layout)
    except format.FormatError as error:
        raise UsageError(f"{source}: as {layout}, {error}") from error


def writer_of(about: dict[str, Any]) -> str:
    """The writer that made a file of this description, or the nearest one."""
    layout = layout_of(about)
    if layout == "compact":
        return "small" if max(about["sh_groups"], default=1) > 1 else "compact"
    if layout == "full":
        return "full" if about["values"] == "F16" else "full32"
    return layout
