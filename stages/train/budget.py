"""A wall-clock budget for training: a schedule whose number of iterations is set by timing steps.

The first steps, in which the learning rate is held, do not depend on the number of iterations: they are timed, and the number that fits into the
rest of the budget follows. The cost of a step changes while a scene takes shape, and with other load, so the number is set again at some fractions
of the budget, by the time of the steps since the last time, and steps end where the budget does. The schedule goes on from where it is. It is
written down each time: a resumed run reads it, and the schedule that a run ended with (`report.json`, field.safetensors) gives the same bytes again when
`efficientnerf.training.loop.train` is given it, on any machine with the same number of threads.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec

from efficientnerf.settings import resolved
from efficientnerf.training.schedule import Schedule, schedule_of
from efficientnerf.training.settings import TrainSettings
from stages.scratch import Warn, note, noted, unusable

FILE = "schedule.json"
# docs/experiments/schedule.md
TIMED = 48  # steps after the warm-up that are timed
MARKS = (0.15, 0.3, 0.5, 0.7, 0.85, 0.95)  # fractions of the budget at which the number of iterations is set again
MIN_TIMED = 8  # steps that have to be timed before that
RESERVE = 0.01  # of the budget, for what comes after the last step
MAX_STEPS = 2**40
UNKNOWN = 10_000_000  # iterations of a schedule whose number is not set yet


class _State(msgspec.Struct):
    """`Schedule.state`."""

    iterations: Annotated[int, msgspec.Meta(ge=1, le=MAX_STEPS)]
    hold: Annotated[int, msgspec.Meta(ge=1)]
    aims: list[tuple[Annotated[int, msgspec.Meta(ge=1, le=MAX_STEPS)], Annotated[int, msgspec.Meta(ge=1)]]]


def _fits(found: _State, hold: int) -> bool:
    """Whether a budget with this hold can have written it: each revision after the one before it, and none after the end."""
    steps = [hold, *(step for _, step in found.aims)]
    return found.hold == hold and steps == sorted(steps) and (not found.aims or steps[-1] <= found.iterations)


def schedule_state(found: object, hold: int) -> dict[str, Any]:
    """A `Schedule.state` of a budget with this hold, of plain values that were read. ValueError where it is none."""
    state = msgspec.convert(found, _State)
    if not _fits(state, hold):
        raise ValueError("no schedule of this run")
    return dict(msgspec.to_builtins(state))


@dataclass
class Budget:
    """The schedule of steps that are to take so many seconds."""

    budget: float  # seconds
    schedule: Schedule  # to begin with, of UNKNOWN iterations and with a hold after which their number is set, or one that was written down
    warmup: int  # steps that are not timed
    spent: float = 0.0  # seconds of it that earlier attempts took
    clock: Callable[[], float] = time.monotonic  # seconds
    written: Callable[[Schedule], object] = lambda schedule: None  # is given each schedule that is set
    started: float = field(init=False)
    timed: tuple[int, float] | None = field(init=False, default=None)  # step and seconds from which on steps are timed
    marks: list[float] = field(init=False)  # seconds at which the number is set again, those to come

    def __post_init__(self) -> None:
        self.started = self.clock()
        self.marks = [fraction * self.budget for fraction in MARKS]

    @property
    def seconds(self) -> float:
        """Of the budget so far, earlier attempts included."""
        return self.spent + self.clock() - self.started

    @property
    def known(self) -> bool:
        """Whether the number of iterations has been set."""
        return self.schedule.iterations != UNKNOWN

    @property
    def goal(self) -> int:
        """Steps to show as the end: while that is not known, of the hold."""
        return self.schedule.iterations if self.known else self.schedule.hold

    def after(self, step: int) -> bool:
        """To be called after each step; whether the schedule is another one now."""
        now = self.seconds
        if self.timed is None and (self.known or step >= min(self.warmup, self.schedule.hold - 1)):
            self.timed = step, now
        passed = [mark for mark in self.marks if mark <= now]
        if not self.known:
            due = step >= self.schedule.hold or now >= self.budget
        else:  # a resumed run takes steps again for which the schedule was made
            enough = bool(passed) and self.timed is not None and step - self.timed[0] >= MIN_TIMED
            # After the last mark other work may slow the steps that are left: none is taken once the budget is over.
            due = (enough or now >= self.budget) and self.schedule.revised_at < step < self.schedule.iterations
        if not due:
            return False
        self.marks = self.marks[len(passed) :]
        iterations = step
        if now < self.budget:
            # An attempt may have begun just before the number is due; then all steps are timed, slow ones of the beginning too.
            timed = self.timed if self.timed is not None and step > self.timed[0] else (0, 0.0)
            each = (now - timed[1]) / (step - timed[0])
            iterations += max(0, int(((1 - RESERVE) * self.budget - now) / max(each, 1e-6)))
        self.schedule = self.schedule.with_iterations(iterations, step) if self.known else replace(self.schedule, iterations=iterations)
        self.timed = step, now
        self.written(self.schedule)
        return True


def training_budget(
    settings: TrainSettings, work: Path, spent: float = 0.0, clock: Callable[[], float] = time.monotonic, warn: Warn = lambda text: None
) -> Budget:
    """The budget of a run with `train.time_budget`.

    settings  as given; train.iterations is ignored
    work      scratch folder, where the schedule is written down
    spent     seconds that earlier attempts trained for
    warn      is called for a schedule that can't be used; the number of iterations is then timed again
    """
    path, warmup = work / FILE, settings.occupancy_warmup_steps
    found = noted(path, _State, warn)
    if found is not None and not _fits(found, warmup + TIMED):
        warn(unusable(path, "no schedule of this run"))
        found = None
    state = msgspec.to_builtins(found) if found else {"iterations": UNKNOWN, "hold": warmup + TIMED, "aims": []}
    return Budget(
        resolved(settings.time_budget) or 0.0, schedule_of(settings, state), warmup, spent, clock, lambda schedule: note(path, schedule.state())
    )  # fmt: skip
