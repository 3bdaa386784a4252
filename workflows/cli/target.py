"""Kinds of paths on the command line: a run, an asset, a stage's folder, a file of a known kind, or a data set."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import BadInput, CorruptArtifact
from pipeline.links import refuse_links
from pipeline.run import NAME
from stages.artifacts import BakeOutputs

if TYPE_CHECKING:
    from efficientnerf.asset.tree import NerfTree
    from pipeline.run import Run

ASSET = BakeOutputs.asset  # the file's name


def resume_command(
    run: Path, *, until: str | None = None, start: str | None = None, only: str | None = None, force: bool = False, with_source: bool = False
) -> str:
    """The command that resumes a run; see `pipeline.run.ResumeText`."""
    folder = shlex.quote(str(run))
    if only is not None:
        return f"enerf stage {only} {folder}" + (" --force" if force else "")
    options = "".join(f" --{option} {stage}" for option, stage in (("from", start), ("until", until)) if stage is not None)
    return f"enerf run{' SOURCE' if with_source else ''} --out {folder}{options}"


def open_run(path: Path) -> Run:
    """The run of a folder, whose messages name commands. Raises BadInput and CorruptArtifact."""
    from pipeline.run import Run

    return Run.open(path, resume_command, _stage_names())


def _stage_names() -> frozenset[str]:
    from workflows.cli.options import workflow

    return frozenset(stage.name for stage in workflow().stages)


def is_run(path: Path) -> bool:
    return (path / NAME).is_file()


def asset_of(path: Path) -> Path:
    """The asset file of a run, of its folder `bake`, or the file itself. Raises BadInput, and CorruptArtifact for a run that holds links."""
    if path.is_file():
        return path
    if not path.exists():
        raise BadInput(f"{path}: no such file or folder. Give a run or an asset ({ASSET}).")
    if is_run(path):
        refuse_links(path, _stage_names())
        found = BakeOutputs.of_run(path).asset
        if not found.is_file():
            raise BadInput(f"{path}: has no asset yet. Make it first: enerf run --out {path} --until bake")
        return found
    if (path / ASSET).is_file():
        return path / ASSET
    raise BadInput(f"{path}: neither a run (it has no {NAME}) nor an asset. Give a run or an asset ({ASSET}).")


def load_asset(path: Path) -> NerfTree:
    """The asset of a run or of a file, read and checked. Raises BadInput and CorruptArtifact."""
    from efficientnerf.asset.format import FormatError, load

    found = asset_of(path)
    try:
        return load(found)
    except FormatError as error:
        raise CorruptArtifact(_with_folder(found, error), (str(found),)) from error


def describe_asset(path: Path) -> dict[str, object]:
    """The header of an asset file. Raises CorruptArtifact."""
    from efficientnerf.asset.format import FormatError, describe

    try:
        return describe(path)
    except FormatError as error:
        raise CorruptArtifact(_with_folder(path, error), (str(path),)) from error


def _with_folder(path: Path, error: Exception) -> str:
    """The error's text, which names the file, with the folder before it."""
    text = str(error)
    return f"{path.parent / text}" if text.startswith(path.name) and str(path.parent) != "." else text
