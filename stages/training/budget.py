"""A wall-clock budget for training, turned into a number of steps that is written down as it goes.

The first steps, in which the learning rate is held, do not depend on how many there will be: they are timed, and the number of steps that fits into the
rest of the budget follows. Steps grow cheaper or dearer while a scene takes shape, and other work comes and goes, so that the number is settled anew at
some shares of the budget, by the time of the steps since the last settling. The schedule goes on from where it stands: what was aimed at until which step is
part of the settings (`train.rate_aims`). Going on after an interruption reads the plan, and `train.iterations`, `train.rate_hold` and `train.rate_aims`
set to what the report names give the same bytes on any machine with the same thread count.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from efficientnerf.settings import given
from efficientnerf.training.settings import TrainSettings
from pipeline.files import write_json

FILE = "plan.json"
TIMED = 48  # steps after the warm-up that are timed
MARKS = (0.15, 0.3, 0.5, 0.7, 0.85, 0.95)  # shares of the budget at which the number of steps is settled anew
FEWEST = 8  # steps that have to be timed before the number is settled anew
RESERVE = 0.01  # of the budget, for what comes after the last step
MOST = 10_000_000


class Plan(NamedTuple):
    """The settings of these names."""

    iterations: int
    rate_hold: int
    rate_aims: tuple[int, ...]

    @property
    def settled(self) -> int:
        """The step from which on the number of steps is what it is."""
        return self.rate_aims[-1] if self.rate_aims else self.rate_hold


@dataclass
class Budget:
    """How the steps of a run with `train.time_budget` are found.

    settings  as given; train.iterations is not heeded
    work      scratch folder, where the plan lies
    spent     seconds that earlier attempts trained for
    clock     seconds, monotonic
    """

    settings: TrainSettings
    work: Path
    spent: float = 0.0
    clock: Callable[[], float] = time.monotonic
    started: float = field(init=False)
    timed: tuple[int, float] | None = field(init=False, default=None)  # step and seconds from which on steps are timed
    plan: Plan | None = field(init=False)
    seconds_given: float = field(init=False)
    marks: list[float] = field(init=False)  # seconds at which to settle, those to come

    def __post_init__(self) -> None:
        self.started = self.clock()
        self.plan = _read(self.work / FILE)
        self.seconds_given = given(self.settings.time_budget) or 0.0
        self.marks = [share * self.seconds_given for share in MARKS]

    @property
    def seconds(self) -> float:
        """Trained for so far, earlier attempts included."""
        return self.spent + self.clock() - self.started

    @property
    def hold(self) -> int:
        return self.settings.rate_hold or self.settings.occupancy_warmup_steps + TIMED

    def planned(self) -> TrainSettings:
        """The settings to begin or to go on with: those of the plan if there is one, else without an end in sight."""
        plan = self.plan or Plan(MOST, self.hold, ())
        return replace(self.settings, time_budget="off", **plan._asdict())

    def after(self, step: int) -> TrainSettings | None:
        """What is settled after a step: the settings with the number of steps, or None where nothing changes. Writes the plan."""
        now = self.seconds
        if self.timed is None and (self.plan is not None or step >= min(self.settings.occupancy_warmup_steps, self.hold - 1)):
            self.timed = step, now
        if not self._due(step, now):
            return None
        iterations = step
        if now < self.seconds_given:
            # An attempt may have begun just before the number has to be settled; then all the steps tell, slow ones of the beginning too.
            known = self.timed is not None and step > self.timed[0]
            each = (now - self.timed[1]) / (step - self.timed[0]) if known and self.timed is not None else now / step
            iterations += max(0, int(((1 - RESERVE) * self.seconds_given - now) / max(each, 1e-6)))
        if self.plan is None:
            self.plan = Plan(iterations, self.hold, ())
        else:
            self.plan = Plan(iterations, self.plan.rate_hold, (*self.plan.rate_aims, self.plan.iterations, step))
        self.timed = step, now
        write_json(self.work / FILE, self.plan._asdict())
        return self.planned()

    def _due(self, step: int, now: float) -> bool:
        """Whether the number of steps is to be settled after this one."""
        passed = [mark for mark in self.marks if mark <= now]
        if self.plan is None:
            due = step >= self.hold or now >= self.seconds_given
        else:  # an interrupted run takes steps again that the plan has been made for
            enough = self.timed is not None and step - self.timed[0] >= FEWEST
            due = bool(passed) and enough and self.plan.settled < step < self.plan.iterations
        if due:
            self.marks = self.marks[len(passed) :]
        return due


def _read(path: Path) -> Plan | None:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        return Plan(int(found["iterations"]), int(found["rate_hold"]), tuple(int(n) for n in found["rate_aims"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None
