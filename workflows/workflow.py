"""A workflow of a command line: stages in order, presets, and forecasts."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.stage import Stage


@dataclass(frozen=True)
class Workflow:
    """Stages and presets of a command line."""

    stages: tuple[Stage, ...]  # in order
    presets: Path  # the folder of its presets, TOML files
    child: str = "workflows.fleet.program"  # the module that runs its stages in processes of their own; see `pipeline.executors.serving`
    # (stage, run, its sources, settings by stage, bytes of memory or None) -> bytes that the stage writes
    space: Callable[[str, Path, Sequence[Path], Mapping[str, Any], int | None], int] = lambda *_: 0
    # (stage, run, its sources, settings by stage, device) -> bytes that the stage takes; None: not known, it has a share of its worker's
    memory: Callable[[str, Path, Sequence[Path], Mapping[str, Any], str], int | None] = lambda *_: None

    @property
    def settings(self) -> dict[str, type]:
        """Stage -> its settings' type."""
        return {stage.name: stage.settings for stage in self.stages}
