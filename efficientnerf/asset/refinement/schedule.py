"""The phases of a refinement, and how many steps each takes. Imports nothing heavy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from efficientnerf.training.schedule import Schedule


class Phase(NamedTuple):
    """Some steps with the same voxels."""

    name: str  # of the phase, as it is shown
    share: float  # of all steps, or of the time where there is a budget


PHASES = (Phase("all voxels", 0.3), Phase("voxels that show", 0.7))  # docs/experiments/tree-training.md


@dataclass(frozen=True)
class RefinementSchedule:
    """How many steps the phases take. It never changes: `with_phase` makes another one. Steps count from 1."""

    # the schedule of each phase, whose steps count from its own first; of those that have begun, where their number follows from the time that they take
    each: tuple[Schedule, ...] = ()

    def begin(self, phase: int) -> int:
        """Steps before a phase."""
        return sum(one.iterations for one in self.each[:phase])

    def fraction(self, step: int) -> float:
        """The fraction of the way that is done after `step`: 0 to 1. Where a phase's number of steps is not known yet, that at its beginning."""
        done, begin = 0.0, 0
        for phase, one in zip(PHASES, self.each, strict=False):
            if step <= begin + one.iterations:
                return done + phase.share * one.fraction(step - begin)
            done, begin = done + phase.share, begin + one.iterations
        return done

    def with_phase(self, phase: int, one: Schedule) -> RefinementSchedule:
        """The schedule with that of a phase begun or changed."""
        return RefinementSchedule((*self.each[:phase], one, *self.each[phase + 1 :]))

    def state(self) -> list[dict[str, Any]]:
        """Decisions of a run, for JSON: with them the same steps are taken again."""
        return [one.state() for one in self.each]


def stated_schedule(steps: int) -> RefinementSchedule:
    """That of `steps` in all."""
    first = int(PHASES[0].share * steps)
    return RefinementSchedule((Schedule(first), Schedule(steps - first)))


def recorded_schedule(state: Sequence[dict[str, Any]]) -> RefinementSchedule:
    """That of a `RefinementSchedule.state`. KeyError, TypeError or ValueError where it is none."""
    found = (Schedule(int(one["iterations"]), int(one["hold"]), tuple((int(n), int(step)) for n, step in one["aims"])) for one in state)
    return RefinementSchedule(tuple(found))
