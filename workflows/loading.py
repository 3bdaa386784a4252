"""Assets of runs and of files, read and checked."""

from pathlib import Path

from efficientnerf.asset.format import FormatError, describe, load
from efficientnerf.asset.tree import NerfTree
from pipeline.errors import CorruptArtifact
from stages.framing.true_frame import load_frame
from workflows.cli.target import asset_of, is_run


def load_asset(path: Path) -> NerfTree:
    """The asset of a run or of a file, read and checked; of a run in the frame that was found since. Raises BadInput and CorruptArtifact."""
    found = asset_of(path)
    try:
        tree = load(found)
    except FormatError as error:
        raise CorruptArtifact(_with_folder(found, error), (str(found),)) from error
    frame = load_frame(path) if is_run(path) else None
    return tree if frame is None else tree.with_metadata(**frame.metadata(tree.metadata))


def describe_asset(path: Path) -> dict[str, object]:
    """The header of an asset file. Raises CorruptArtifact."""
    try:
        return describe(path)
    except FormatError as error:
        raise CorruptArtifact(_with_folder(path, error), (str(path),)) from error


def _with_folder(path: Path, error: Exception) -> str:
    """The error's text, which names the file, with the folder before it."""
    text = str(error)
    return f"{path.parent / text}" if text.startswith(path.name) and str(path.parent) != "." else text
