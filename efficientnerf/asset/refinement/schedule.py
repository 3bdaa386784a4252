"""The phases of a refinement: how many steps each takes, and what becomes of the tree at its end. Imports nothing heavy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Any, Literal

from efficientnerf.training.schedule import Schedule

Operation = Literal["none", "prune", "split"]


@dataclass(frozen=True)
class Phase:
    """Some steps with the same voxels.

    name   of the phase, as it is shown
    share  of all steps, or of the time where there is a budget; the shares of all phases sum to 1
    after  what is done to the tree after the last of its steps: "prune" drops voxels that do not show; "split" does too, and replaces those that are left by
           their eight children, on a grid of twice the resolution
    """

    name: str
    share: float
    after: Operation = "none"


# docs/experiments/tree-training.md
PHASES = (Phase("all voxels", 0.3, "prune"), Phase("voxels that show", 0.7))


def count_splits(phases: Sequence[Phase]) -> int:
    """How often the resolution is doubled in these phases."""
    return sum(phase.after == "split" for phase in phases)


@dataclass(frozen=True)
class RefinementSchedule:
    """How many steps the phases take. It never changes: `with_phase` makes another one. Steps count from 1.

    each  the schedule of each phase, whose steps count from its own first; of those that have begun, where their number follows from the time that they take
    """

    phases: tuple[Phase, ...]
    each: tuple[Schedule, ...] = ()

    def begin(self, phase: int) -> int:
        """Steps before a phase."""
        return sum(one.iterations for one in self.each[:phase])

    def fraction(self, step: int) -> float:
        """The fraction of the way that is done after `step`: 0 to 1. Where a phase's number of steps is not known yet, that at its beginning."""
        done, begin = 0.0, 0
        for phase, one in zip(self.phases, self.each, strict=False):
            if step <= begin + one.iterations:
                return done + phase.share * one.fraction(step - begin)
            done, begin = done + phase.share, begin + one.iterations
        return done

    def with_phase(self, phase: int, one: Schedule) -> RefinementSchedule:
        """The schedule with that of a phase begun or changed."""
        return RefinementSchedule(self.phases, (*self.each[:phase], one, *self.each[phase + 1 :]))

    def state(self) -> list[dict[str, Any]]:
        """What a run decided, as JSON holds it: with it the same steps are taken again."""
        return [one.state() for one in self.each]


def stated_schedule(phases: Sequence[Phase], steps: int) -> RefinementSchedule:
    """That of so many steps in all."""
    ends = [0, *(int(round(share, 9) * steps) for share in accumulate(phase.share for phase in phases))]
    return RefinementSchedule(tuple(phases), tuple(Schedule(end - begin) for begin, end in pairwise(ends)))


def recorded_schedule(phases: Sequence[Phase], state: Sequence[dict[str, Any]]) -> RefinementSchedule:
    """That of a `RefinementSchedule.state`. KeyError, TypeError or ValueError where it is none."""
    found = (Schedule(int(one["iterations"]), int(one["hold"]), tuple((int(n), int(step)) for n, step in one["aims"])) for one in state)
    return RefinementSchedule(tuple(phases), tuple(found))


def exponential_fall(ratio: float, steps: int) -> Callable[[int], float]:
    """Factor of learning rates that fall exponentially, to `ratio` after so many steps."""
    return lambda step: float(ratio ** (step / steps))
