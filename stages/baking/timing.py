"""Where the time of a bake goes: how much of bake.time_budget each phase of the refinement may take."""

from __future__ import annotations

from collections.abc import Sequence

from efficientnerf.asset.refinement.schedule import Phase
from efficientnerf.training.schedule import Schedule
from stages.compiling import clock
from stages.training.budget import UNKNOWN

# docs/experiments/refinement.md
WARMUP, TIMED = 2, 8  # first steps of a phase that are not timed; those after them that are, before the number of its steps is set
FINISH_SECONDS_PER_VOXEL = 3e-6  # that the palettes and the file take
WEIGHT_SECONDS = 0.5  # that a ray takes which is rendered for voxel weights, over one whose error is measured
HOLD = WARMUP + TIMED


class Stopwatch:
    """Seconds of the stage so far, earlier attempts included up to the checkpoint that this one goes on from."""

    def __init__(self) -> None:
        self._began = clock()

    @property
    def seconds(self) -> float:
        return clock() - self._began

    def set(self, seconds: float) -> None:
        self._began = clock() - seconds


def allotted(phases: Sequence[Phase], phase: int, left: float) -> float:
    """Seconds of those left that a phase may take: its share among those to come."""
    return max(0.0, left) * phases[phase].share / sum(one.share for one in phases[phase:])


def timed_schedule() -> Schedule:
    """That of a phase whose number of steps is not known yet."""
    return Schedule(UNKNOWN, HOLD)
