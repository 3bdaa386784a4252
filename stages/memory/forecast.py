"""A forecast of a stage's memory and disk space at its peak, before it begins: fleets admit stages by it.

`stages.NAME.memory` of each stage has two functions of what is `Known` then.

    memory_needed  the terms by which the stage itself finds whether it fits, pixels in memory, on all of its cores; of assets the header alone is read
    space_needed   bytes of its scratch and its artifact, with what it would write for an interruption

docs/experiments/memory.md, fleet.md
"""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from stages.artifacts import PosesOutputs
from stages.memory.need import MIB, Need

MIN_SPACE = MIB // 4  # bytes: logs, plots, manifests, previews of small pictures
PREVIEWS = 6  # pictures of a stage, as large as a working image


@dataclass(frozen=True)
class Known:
    """What is known before a stage begins."""

    run: Path
    sources: Sequence[Path]
    settings: Mapping[str, Any]  # of each stage by its name, dataclasses
    device: str = "cpu"  # that it computes on
    memory: int | None = None  # bytes that it may take: what does not fit there is written; None: no limit

    def pictures(self) -> int:
        """Bytes of previews and figures as large as a working image."""
        return PREVIEWS * max(sizes_below([PosesOutputs.of_run(self.run).images]), default=0)


def memory_needed(stage: str, run: Path, sources: Sequence[Path], settings: Mapping[str, Any], device: str = "cpu") -> int:
    """Bytes that a stage of this name takes. The artifacts that it needs are there."""
    need: Need = _of(stage).memory_needed(Known(run, sources, settings, device))
    return need.total


def space_needed(stage: str, run: Path, sources: Sequence[Path], settings: Mapping[str, Any], memory: int | None = None) -> int:
    """Bytes that a stage of this name writes in so much memory. The artifacts that it needs are there."""
    written: int = _of(stage).space_needed(Known(run, sources, settings, memory=memory))
    return MIN_SPACE + written


def _of(stage: str) -> Any:
    return import_module(f"stages.{stage}.memory")


def files_below(place: Path) -> list[Path]:
    """The plain files below a folder, links left out; of a file itself."""
    if place.is_file():
        return [place]
    return [path for parent, _, names in os.walk(place) for name in names if not (path := Path(parent, name)).is_symlink()]


def sizes_below(places: Iterable[Path]) -> list[int]:
    """Bytes of each of these files."""
    return [os.stat(path).st_size for place in places for path in files_below(place)]
