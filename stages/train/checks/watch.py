"""What happens when the early check finds that nothing is learned: `train.on_failure`.

Results and decisions are noted in the scratch folder, so that a run that is killed anywhere ends with the same bytes: the check's result, each trial's, and
last the choice. The checkpoints of the training that failed are removed before that is noted.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.geometry.cameras import Camera
from efficientnerf.training.pixels import Pixels
from pipeline.errors import StageFailed
from pipeline.files import remove
from pipeline.stage import Job
from stages.io.scene import Scene
from stages.scratch import note, noted
from stages.train import budget
from stages.train.checks.early_check import EarlyResult, check_step, held_out_views, judge
from stages.train.checks.second_chances import Trial, best_of, try_all
from stages.train.choices import TrainingChoices, write

DECIDED = "second_chances.json"
REMEDY = "Check the cameras and photographs in the report. If there are masks, try poses.masks=ignore."


@dataclass(frozen=True)
class _Decision:
    chosen: str | None  # name of the trial whose choices training begins again with; None: it goes on as it is
    choices: TrainingChoices  # of that trial
    seconds: float  # that were trained in vain
    trials: list[Trial]  # all that were made, in their order


class Watch:
    """Watches a training run for whether anything is learned.

    scene, settings  what is to be trained with: as they are given, or with what was chosen after an earlier training had failed
    seconds          of that earlier training
    """

    def __init__(self, job: Job, stated: Scene, folder: Path) -> None:
        """
        stated  the scene, as the poses stage left it in `folder`
        """
        self.job, self.stated, self.folder = job, stated, folder
        self.decision = noted(job.work / DECIDED, _Decision, job.warn)
        self.choices = TrainingChoices() if self.decision is None else self.decision.choices
        self.scene, self.settings = self.choices.scene(stated), self.choices.settings(job.settings)
        self.seconds = 0.0 if self.decision is None or not self.again else self.decision.seconds
        self.notes = [job.work / "early_check.json", *([job.work / "early_check_again.json"] if self.again else [])]
        self.results = [noted(path, EarlyResult, job.warn) for path in self.notes]

    @property
    def again(self) -> bool:
        """Whether an earlier training failed, and this one has other choices."""
        return self.choices != TrainingChoices()

    def begins_again(
        self, render: Callable[[Camera], np.ndarray], pixels: Pixels, save: Callable[[], object], step: int, iterations: int, seconds: float
    ) -> bool:
        """Whether training has to begin again with other choices, which are noted; to be called before the first step of an attempt, and after each.

        render   colours (H, W, 3) that a camera sees of the field
        pixels   of the training views
        save     writes a checkpoint
        seconds  trained so far

        StageFailed where nothing is learned and `train.on_failure=stop`.
        """
        if self.results[-1] is None:
            due = check_step(iterations)
            if due is None or step < due:
                return False
            self._judge(step, render)
        result = self.results[-1]
        if result is None or result.learning or self.decision is not None:
            return False
        if self.job.settings.on_failure == "stop":
            raise StageFailed(f"train: {_in_words(result)}. {REMEDY} Set train.on_failure=continue to train anyway.")
        if self.job.settings.on_failure == "continue":
            return False
        if step:
            save()
        return self._decide(pixels, seconds)

    def _judge(self, step: int, render: Callable[[Camera], np.ndarray]) -> None:
        """Compare with the held-out views, and note what is found."""
        result = judge(held_out_views(self.folder, self.stated), render, step)
        if result is None:
            return
        self.results[-1] = result
        note(self.notes[-1], asdict(result))
        if result.learning:
            return
        follows = " Trying what has helped others." if self.job.settings.on_failure == "retry" and not self.again else ""
        self.job.warn(f"{_in_words(result)}.{follows}", early_check=asdict(result))

    def _decide(self, pixels: Pixels, seconds: float) -> bool:
        """Try second chances; whether one of them is clearly better."""
        trials = try_all(self.job, self.stated, self.job.settings, pixels, held_out_views(self.folder, self.stated))
        best = best_of(trials)
        self.decision = _Decision(None, TrainingChoices(), seconds, trials) if best is None else _Decision(best.name, best.choices, seconds, trials)
        if best is None:
            self.job.warn(f"none of {len(trials) - 1} second chances is clearly better than the given settings; training continues. {REMEDY}")
        else:
            # Remove what the training that failed left to go on from.
            for pattern in ("checkpoint_*.safetensors", "preview_*.png", budget.FILE):
                for path in self.job.work.glob(pattern):
                    remove(path)
            self.job.warn(f"training restarts with {best.name}: {best.result.psnr:.2f} dB in its short training, {trials[0].result.psnr:.2f} dB without")
        note(self.job.work / DECIDED, asdict(self.decision))
        return best is not None

    def write_choices(self, path: Path) -> None:
        """Write what later stages need to know, where anything was chosen, and what was found into the manifest."""
        self.job.record("early_check", self.report())
        if self.again:
            write(self.choices, path)

    def report(self) -> dict[str, Any]:
        """For report.json, and the manifest."""
        trials = [] if self.decision is None else self.decision.trials
        return {
            "early_check": [asdict(check) | {"learning": check.learning} for check in self.results if check is not None],
            "second_chances": [{"name": trial.name, **asdict(trial.result)} for trial in trials],
            "chosen": None if self.decision is None else self.decision.chosen,
        }


def _in_words(result: EarlyResult) -> str:
    plain = f"one colour comes to {result.mean_colour_psnr:.2f} dB, a blurred photograph to {result.blurred_psnr:.2f}"
    return f"nothing has been learned in {result.step} steps: held-out views are rendered at {result.psnr:.2f} dB, where {plain}"
