"""Checkpoints in the stage's scratch folder, which belongs to the request; the last two are kept."""

from pathlib import Path
from typing import Annotated

import msgspec
import torch

from efficientnerf.training.loop import Trainer, restore, state_of
from pipeline.errors import CorruptArtifact
from pipeline.files import remove
from pipeline.stage import Job
from pipeline.text import printable
from stages.io.field_file import read_tensors, write_tensors
from stages.train.log import TrainLog

KEPT = 2
MAX_SECONDS = 1e10  # three centuries


class _About(msgspec.Struct):
    """A checkpoint's metadata."""

    step: Annotated[int, msgspec.Meta(ge=1)]
    seconds: Annotated[float, msgspec.Meta(ge=0, le=MAX_SECONDS)]


class Checkpoints:
    """Saves and restores a trainer. A run that goes on from a checkpoint ends with the bytes of a run that was never interrupted."""

    def __init__(self, job: Job) -> None:
        self.job = job

    def paths(self) -> list[Path]:
        """From the oldest to the newest."""
        return sorted(self.job.work.glob("checkpoint_*.safetensors"))

    def reach(self, t: Trainer, log: TrainLog, *, every: int, last: bool) -> None:
        """A safe point after a step: saved where that is due, and where the run is interrupted here; after the last step there is nothing to go on to."""
        if t.step % every == 0 and not last:
            self.save(t, log)
        try:
            self.job.safe_point()
        except BaseException:
            if not last:
                self.save(t, log)
            raise

    def save(self, t: Trainer, log: TrainLog) -> None:
        """The trainer after its step, and the log up to it."""
        log.flush()
        write_tensors(state_of(t), {"step": t.step, "seconds": log.seconds}, self.job.work / _name(t.step))
        for old in self.paths()[:-KEPT]:
            remove(old)

    def restore(self, t: Trainer, last: int) -> float:
        """Restore the newest checkpoint that can be used, if there is one; the seconds that were trained up to it. One that can't be is removed, and
        has changed nothing.

        last  the step that training ends with
        """
        for path in reversed(self.paths()):
            try:
                seconds = _restore(t, path, last)
            except (CorruptArtifact, ValueError, OSError) as error:
                self.job.warn(f"{path.name} can't be used ({printable(error, 300)}); resuming from the previous one")
                remove(path)
                continue
            self.job.say(f"resuming training from step {t.step}")
            return seconds
        return 0.0


def _restore(t: Trainer, path: Path, last: int) -> float:
    """Restore a checkpoint: all of it, or nothing where this raises."""
    tensors, about = read_tensors(path)
    try:
        about = msgspec.convert({"step": about.get("step"), "seconds": about.get("seconds")}, _About)
    except msgspec.ValidationError as error:
        raise ValueError(str(error)) from None
    progress = tensors.get("progress")
    if progress is None or progress.dtype != torch.float64 or progress.shape != (2,):  # other types do not even convert
        raise ValueError("tensor 'progress' is missing, or no two float64")
    if path.name != _name(about.step) or float(progress[0]) != about.step:
        raise ValueError(f"it is of step {about.step}, by its own account")
    if about.step >= last:
        raise ValueError(f"step {about.step} of {last}")
    restore(t, tensors)
    return about.seconds


def _name(step: int) -> str:
    return f"checkpoint_{step:08d}.safetensors"
