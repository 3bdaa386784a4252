"""A wall-clock budget for training, turned into a number of steps once and then fixed.

The first steps, in which the learning rate is held, do not depend on how many there will be: they are timed, the number of steps that fits into the
rest of the budget follows, and it is written down. From then on the run is one of that many steps like any other: going on after an interruption reads
the number, and `train.iterations` and `train.rate_hold` set to what the report names give the same bytes on any machine with the same thread count.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from efficientnerf.settings import TrainSettings
from stages.exporters.aside import written_aside

FILE = "plan.json"
TIMED = 48  # steps after the warm-up that are timed
RESERVE = 0.03  # of the budget, for checkpoints and previews
MOST = 10_000_000


@dataclass
class Budget:
    """How the steps of a run with `train.budget` are found.

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
    warmed: tuple[int, float] | None = field(init=False, default=None)  # step and seconds from which on steps are timed

    def __post_init__(self) -> None:
        self.started = self.clock()

    @property
    def seconds(self) -> float:
        """Trained for so far, earlier attempts included."""
        return self.spent + self.clock() - self.started

    @property
    def hold(self) -> int:
        return self.settings.rate_hold or self.settings.warm_up + TIMED

    def planned(self) -> TrainSettings:
        """The settings to begin or to go on with: those of the plan if there is one, else without an end in sight."""
        if (found := _read(self.work / FILE)) is not None:
            return replace(self.settings, budget=0.0, iterations=found[0], rate_hold=found[1])
        return replace(self.settings, budget=0.0, iterations=MOST, rate_hold=self.hold)

    def after(self, step: int) -> TrainSettings | None:
        """What is fixed after a step: the settings with the number of steps, or None where it is too early. Writes the plan."""
        if self.warmed is None and step >= min(self.settings.warm_up, self.hold - 1):
            self.warmed = step, self.seconds
        over = self.seconds >= self.settings.budget
        if not over and step < self.hold:
            return None
        iterations = step
        if not over and self.warmed is not None and step > self.warmed[0]:
            each = (self.seconds - self.warmed[1]) / (step - self.warmed[0])
            left = (1 - RESERVE) * self.settings.budget - self.seconds
            iterations += max(0, int(left / max(each, 1e-6)))
        with written_aside(self.work / FILE) as aside:
            aside.write_text(json.dumps({"iterations": iterations, "rate_hold": self.hold}, sort_keys=True) + "\n", encoding="utf-8")
        return self.planned()


def _read(path: Path) -> tuple[int, int] | None:
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        return int(found["iterations"]), int(found["rate_hold"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
