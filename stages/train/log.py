"""The log of a training run or a refinement, and the curve that is drawn of it."""

import json
import math
import shutil
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import msgspec

from efficientnerf.training.loop import Progress
from pipeline.files import atomic, remove, write_atomically
from stages.figures.plots import curve
from stages.scratch import opened

EVERY = 10  # steps
SMOOTHING = 0.95  # of the running mean of the loss
RECENT = 50  # lines whose steps say how long those to come take, previews and checkpoints between them included


class _Line(msgspec.Struct):
    """The schema of a line that is read again."""

    step: Annotated[int, msgspec.Meta(ge=0, le=2**53)]
    psnr: Annotated[float, msgspec.Meta(ge=-1000, le=1000)] | None
    preview_psnr: Annotated[float, msgspec.Meta(ge=-1000, le=1000)] | None = None


class Log:
    """log.jsonl of a stage. Lines are written by `flush`."""

    def __init__(self, path: Path, step: int) -> None:
        """step  that is gone on from; lines after it are dropped, for they will be logged again"""
        self.path = path
        self.unwritten: list[str] = []
        kept = [line for line in read_lines(path) if line["step"] <= step]
        remove(path)  # a folder of that name could not be replaced
        write_atomically(path, "".join(json.dumps(line, sort_keys=True) + "\n" for line in kept).encode(), durable=False)

    def add(self, line: dict[str, Any]) -> None:
        self.unwritten.append(json.dumps(line, sort_keys=True))

    def flush(self) -> None:
        with open(self.path, "a", encoding="utf-8") as file:
            file.writelines(line + "\n" for line in self.unwritten)
        self.unwritten.clear()

    def draw_curve(self, path: Path) -> None:
        """PSNR over steps, of the training rays and of the previews."""
        lines = [*read_lines(self.path), *map(json.loads, self.unwritten)]
        known = [x for x in lines if x["psnr"] is not None]
        series = {"training rays, running mean": ([x["step"] for x in known], [x["psnr"] for x in known])}
        previews = [(x["step"], x["preview_psnr"]) for x in lines if x.get("preview_psnr") is not None]
        if previews:
            series["preview view"] = ([step for step, _ in previews], [psnr for _, psnr in previews])
        with atomic(path, durable=False) as temporary:
            curve(temporary, series, x_label="step", y_label="PSNR / dB")

    def publish(self, path: Path, curve_path: Path) -> None:
        """Write the whole log, and its curve, to these files of the artifact."""
        self.flush()
        shutil.copyfile(self.path, path)
        self.draw_curve(curve_path)


class TrainLog(Log):
    """The log of a training run: a line every few steps, and at each preview.

        seconds       of the stage so far, previews and checkpoints included
        step_seconds  of a step alone, the mean since the last line
        loss, psnr    running means over the training rays
        left_out      of the step's rays, those whose samples did not fit their capacity

    On CUDA counts and the fraction of valid voxels are those of some steps before (`efficientnerf.training.readback`).
    """

    def __init__(self, path: Path, step: int, spent: float, occupied: Callable[[], float], clock: Callable[[], float]) -> None:
        """
        step, spent  the step that training goes on from, and the seconds up to it
        occupied     the fraction of valid voxels
        clock        seconds, monotonic
        """
        super().__init__(path, step)
        self.first, self.spent, self.occupied, self.clock = step, spent, occupied, clock
        self.began = self.step_began = clock()
        self.logged, self.working = step, 0.0
        self.loss, self.fraction = 0.0, 0.0
        self.rates: dict[str, Any] = {}
        self.recent: deque[tuple[int, float]] = deque(maxlen=RECENT + 1)  # steps, and the seconds up to each

    @property
    def seconds(self) -> float:
        """Trained for, earlier attempts included."""
        return self.spent + self.clock() - self.began

    def begin_step(self) -> None:
        self.step_began = self.clock()

    def end_step(self, done: Progress) -> None:
        self.working += self.clock() - self.step_began
        self.loss = done.loss if done.step == self.first + 1 else SMOOTHING * self.loss + (1 - SMOOTHING) * done.loss

    def record(self, done: Progress, goal: int, psnr: float | None, *, last: bool) -> dict[str, Any]:
        """Log the step where it is time; returns what a display shows of it.

        goal  steps that are planned
        psnr  of the preview that was drawn after this step, if one was
        """
        seconds, due = self.seconds, done.step % EVERY == 0 or last
        if due or psnr is not None or not self.rates:
            self.fraction = self.occupied()
        if due or psnr is not None:
            self.add({
                "step": done.step,
                "seconds": round(seconds, 3),
                "step_seconds": round(self.working / (done.step - self.logged), 6),
                "loss": self.loss,
                "psnr": psnr_of(self.loss),
                "preview_psnr": psnr,
                "rays": done.rays,
                "tried": done.tried,
                "valid": done.valid,
                "pivotal": done.pivotal,
                "fine": done.fine,
                "left_out": done.left_out,
                "occupied": self.fraction,
            })
            self.working, self.logged = 0.0, done.step
        if due or not self.rates:
            # By the last steps of this attempt. Its first step says nothing of those to come: kernels are loaded in it.
            self.recent.append((done.step, seconds))
            step, began = self.recent[0]
            self.rates = {"occupied": round(self.fraction, 4)}
            if done.step > step:
                each = max((seconds - began) / (done.step - step), 1e-9)
                self.rates |= {"samples_per_s": round((done.valid + done.fine) / each), "left": round(each * max(0, goal - done.step), 1)}
        return {"loss": self.loss, "psnr": round(psnr_of(self.loss), 2), **self.rates}


def psnr_of(loss: float) -> float:
    """dB, of a mean squared error."""
    return -10 * math.log10(max(loss, 1e-10))


def read_lines(path: Path) -> list[dict[str, Any]]:
    """The lines of a log, up to one that was cut short by a kill or is none of a log; none where there is no file yet."""
    out: list[dict[str, Any]] = []
    try:
        with opened(path) as file:
            for text in file:
                msgspec.json.decode(text, type=_Line)
                out.append(json.loads(text))
    except (OSError, ValueError, RecursionError, msgspec.MsgspecError):
        pass
    return out
