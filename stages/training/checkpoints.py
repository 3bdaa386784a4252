"""Checkpoints in the stage's scratch folder, which belongs to the request; the last two are kept."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from efficientnerf.training.loop import Trainer
    from pipeline.stage import Job
    from stages.training.log import TrainLog

KEPT = 2


class Checkpoints:
    """Saves and restores a trainer. A run that goes on from a checkpoint ends with the bytes of a run that was never interrupted."""

    def __init__(self, job: Job) -> None:
        self.job = job

    def paths(self) -> list[Path]:
        """From the oldest to the newest."""
        return sorted(self.job.work.glob("checkpoint_*.safetensors"))

    def save(self, t: Trainer, log: TrainLog) -> None:
        """The trainer after its step, and the log up to it."""
        from efficientnerf.training.loop import state_of
        from stages.io.field_file import write_tensors

        log.flush()
        write_tensors(state_of(t), {"step": t.step, "seconds": log.seconds}, self.job.work / f"checkpoint_{t.step:08d}.safetensors")
        for old in self.paths()[:-KEPT]:
            old.unlink()

    def restore(self, t: Trainer) -> float:
        """Restore the newest checkpoint that can be read, if there is one; the seconds that were trained up to it."""
        from efficientnerf.training.loop import restore
        from pipeline.errors import CorruptArtifact
        from stages.io.field_file import read_tensors

        for path in reversed(self.paths()):
            try:
                tensors, about = read_tensors(path)
                restore(t, tensors)
                seconds = float(about["seconds"])
            except (CorruptArtifact, KeyError, ValueError) as error:
                self.job.warn(f"{path.name} can't be used ({error}); going on from the one before it")
                path.unlink()
                continue
            self.job.say(f"training goes on from step {t.step}")
            return seconds
        return 0.0
