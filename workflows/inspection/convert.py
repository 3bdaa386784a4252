"""`enerf convert`: an asset in another layout, resolution or degree."""

import hashlib
from pathlib import Path
from typing import Any

import click

from efficientnerf.asset import conversion, format
from efficientnerf.asset.file.metadata import layout_of
from pipeline.errors import UsageError
from workflows.cli.options import folder_type, force_option, output_options
from workflows.cli.output import conclude
from workflows.cli.progress import size
from workflows.cli.target import asset_of
from workflows.destination import check_files, writing
from workflows.loading import load_asset

LAYOUTS = tuple(format.WRITERS)


@click.command()
@click.argument("what", metavar="RUN|ASSET", type=folder_type)
@click.argument("out", metavar="OUT", type=folder_type)
@click.option("--layout", type=click.Choice(LAYOUTS), help="Voxel layout of OUT; by default that of ASSET.")
@click.option("--sh-degree", "degree", type=click.IntRange(0, 4), help="Keep the spherical harmonics up to this degree.")
@click.option("--resolution", type=click.IntRange(1, 65536), help="Voxels along the longest side, or of the innermost cascade; fewer than ASSET has.")
@force_option
@output_options
def convert(what: Path, out: Path, layout: str | None, degree: int | None, resolution: int | None, force: bool, as_json: bool, quiet: bool) -> None:
    """Write the asset of RUN, or ASSET, to the file OUT.

    Layouts: compact (4 bytes per voxel, and one per harmonic above the first), packed (the same, entropy-coded, to send or keep), small (6 bytes per
    voxel), sparse (16-bit floats), full (all voxels of each brick, 16-bit floats), full32 (the same, 32-bit floats). OUT is written completely or
    not at all. An existing file is replaced only with --force, a file of a run never.
    """
    if out.suffix.lower() != ".nerftree":
        raise UsageError(f"{out}: the extension {out.suffix!r} is not that of an asset; expected .nerftree. For meshes and points: enerf export")
    check_files([out], force=force, inputs=[asset_of(what)])
    with writing(out, force=force):
        _write(what, out, layout, degree, resolution)
    about = format.describe(out)
    facts = {key: about[key] for key in ("layout", "resolution", "voxels", "sh_degree", "bytes", "bytes_per_voxel")}
    words = f"{out}: {about['layout']}, {about['voxels']} voxels, degree {about['sh_degree']}, {size(about['bytes'])}"
    conclude(words, as_json=as_json, quiet=quiet, written=[{"path": str(out.absolute()), **facts}])


def _write(what: Path, out: Path, layout: str | None, degree: int | None, resolution: int | None) -> None:
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
