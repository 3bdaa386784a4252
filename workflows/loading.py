"""Assets of runs and of files, read and checked."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from efficientnerf.asset.format import FormatError, describe, load
from efficientnerf.asset.tree import NerfTree
from pipeline.errors import CorruptArtifact
from stages.framing.true_frame import load_frame
from workflows.cli.target import asset_of, is_run


def load_asset(path: Path) -> NerfTree:
    """The asset of a run or of a file, read and checked; of a run in the frame that was found since. Raises BadInput and CorruptArtifact."""
    found = asset_of(path)
    with damage_of(found):
        tree = load(found)
    frame = load_frame(path) if is_run(path) else None
    return tree if frame is None else tree.with_metadata(**frame.metadata(tree.metadata))


def describe_asset(path: Path) -> dict[str, object]:
    """The header of an asset file. Raises CorruptArtifact."""
    with damage_of(path):
        return describe(path)


@contextmanager
def damage_of(path: Path) -> Iterator[None]:
    """While open, a damaged asset in this file raises CorruptArtifact, which names the file with its folder."""
    try:
        yield
    except FormatError as error:
        text = str(error)
        if text.startswith(path.name):
            text = str(path.parent / text)
        raise CorruptArtifact(text if text.startswith(str(path)) else f"{path}: {text}", (str(path),)) from error
