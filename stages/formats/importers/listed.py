"""Formats that list frames: how one is recognised and read, with what all of them have in common."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipeline.errors import BadInput
from stages.formats.importers import frames
from stages.formats.importers.depth import DepthFile, with_depth
from stages.formats.importers.source import ImportSettings, Source
from stages.io.capture import Capture


def _no_depth(stem: str) -> None:
    """Where a format has no depth maps."""


@dataclass(frozen=True)
class Listed:
    """What a source states.

    where  what messages call it
    files  those that state it
    depth  by the stem of an image
    more   further arguments of `frames.capture_of`
    """

    where: str
    frames: list[frames.Frame]
    files: Sequence[Path]
    depth: Callable[[str], DepthFile | None] = _no_depth
    more: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ListFormat:
    """See `stages.formats.importers.Importer`.

    expected    what a folder of this format holds, for messages
    signs       files that a folder of this format has
    listed      what the source states; BadInput where it cannot be read
    recognised  whether they are of this format, where their being there does not tell
    """

    kind: str
    expected: str
    signs: Callable[[Source], Sequence[Path]]
    listed: Callable[[Source, Sequence[Path]], Listed]
    recognised: Callable[[Source, Sequence[Path]], bool] = lambda source, signs: True

    def recognises(self, folder: Path, allow_outside: bool = False) -> bool:
        source = Source(folder, allow_outside)
        signs = self.signs(source)
        return bool(signs) and self.recognised(source, signs)

    def files(self, folder: Path, settings: ImportSettings) -> list[Path]:
        """What states the cameras, the images, their masks and depth maps. Raises BadInput."""
        source, found = self._read(folder, settings)
        images = frames.files_of(source, found.frames)
        maps = [one for path in images if (one := found.depth(path.stem)) is not None]
        return [*found.files, *images, *(path for one in maps for path in (one.file, one.confidence) if path is not None)]

    def read(self, folder: Path, settings: ImportSettings) -> Capture:
        """The capture that the source describes. Raises BadInput."""
        source, found = self._read(folder, settings)
        capture = frames.capture_of(source, found.frames, settings, kind=self.kind, where=found.where, **found.more)
        return with_depth(capture, lambda photo: found.depth(photo.image.stem))

    def _read(self, folder: Path, settings: ImportSettings) -> tuple[Source, Listed]:
        source = Source(folder, settings.allow_outside)
        signs = self.signs(source)
        if not signs:
            raise BadInput(f"{source.root}: nothing of {self.kind}: expected {self.expected}. Choose another format with --as.")
        return source, self.listed(source, signs)
