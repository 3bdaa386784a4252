"""The length of training, and what depends on its progress: learning rate, samples per pivot. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from efficientnerf.settings import resolved
from efficientnerf.training.settings import TrainSettings

RAMP_STEPS = 100  # steps in which the learning rate rises, or the first tenth of a shorter run


@dataclass(frozen=True)
class Schedule:
    """A schedule never changes: `with_iterations` makes another one. Steps count from 1."""

    iterations: int  # steps in all
    hold: int = 0  # first steps in which the learning rate does not fall, so that nothing in them depends on `iterations`
    aims: tuple[tuple[int, int], ...] = ()  # (iterations, step) in order: up to `step` the schedule was one of so many iterations
    learning_rate: float = 2e-2  # peak of the learning rate
    lr_final_ratio: float = 0.05  # what is left of it after the last step, or after each `lr_decay_steps`
    lr_decay_steps: int = 0  # steps in which it falls by `lr_final_ratio`; 0: all of them
    samples_per_pivot: int = 4  # N_s
    early_samples_per_pivot: int = 0  # N_s in the first half; 0: the same
    ramp_steps: int = RAMP_STEPS  # first steps in which the learning rate rises, at most

    def fraction(self, step: int) -> float:
        """The fraction of the way from the end of the hold to the last step that is done after `step`: 0 to 1."""
        done, begin = 0.0, self.hold
        for iterations, until in (*self.aims, (self.iterations, self.iterations)):
            done += (1 - done) * min(1.0, max(0, min(step, until) - begin) / max(1, iterations - begin))
            begin = max(begin, until)
        return done

    def learning_rate_at(self, step: int) -> float:
        """Rises linearly over the first steps, is held up to step `hold`, then falls exponentially."""
        ramp = max(1, min(self.ramp_steps, self.hold or self.iterations // 10))
        fallen = max(0, step - self.hold) / self.lr_decay_steps if self.lr_decay_steps else self.fraction(step)
        return self.learning_rate * min(1.0, step / ramp) * self.lr_final_ratio**fallen

    def samples_per_pivot_at(self, step: int) -> int:
        """N_s of a step. Few samples on a ray make many rays in a step, which an early field learns more from."""  # docs/experiments/sampling.md
        early = self.early_samples_per_pivot and self.fraction(step) < 0.5
        return min(self.early_samples_per_pivot, self.samples_per_pivot) if early else self.samples_per_pivot

    def with_iterations(self, iterations: int, step: int) -> Schedule:
        """The schedule with another number of iterations from `step` on. The steps up to `step` stay as they were."""
        return replace(self, iterations=iterations, aims=(*self.aims, (self.iterations, step)))

    @property
    def revised_at(self) -> int:
        """The last step that an earlier number of iterations still decided."""
        return self.aims[-1][1] if self.aims else self.hold

    def state(self) -> dict[str, Any]:
        """Decisions of a run, for JSON; the rest are settings."""
        return {"iterations": self.iterations, "hold": self.hold, "aims": [list(aim) for aim in self.aims]}


def schedule_of(settings: TrainSettings, state: dict[str, Any] | None = None) -> Schedule:
    """The schedule of the settings; with a `Schedule.state`, the one that a run with these settings ended with, which repeats it to the byte.

    KeyError, TypeError or ValueError where `state` is not one.
    """
    state = state or {"iterations": settings.iterations, "hold": 0, "aims": []}
    return Schedule(
        int(state["iterations"]),
        int(state["hold"]),
        tuple((int(iterations), int(step)) for iterations, step in state["aims"]),
        settings.learning_rate,
        settings.lr_final_ratio,
        resolved(settings.lr_decay_steps) or 0,
        settings.samples_per_pivot,
        resolved(settings.early_samples_per_pivot) or 0,
    )
