"""A workflow of toy stages, for testing the command line in a blink."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from efficientnerf.settings import PositiveInt, setting
from pipeline.errors import BadInput
from pipeline.stage import Job, Stage


@dataclass(frozen=True)
class PosesSettings:
    format: Literal["auto", "photographs"] = setting("auto", "What the source is.")
    strict: bool = setting(False, "Whether to refuse.")
    allow_outside: bool = setting(False, "Whether to allow.")
    repeat: Annotated[int, Meta(ge=1, le=9)] = setting(1, "How often the text is repeated.")


@dataclass(frozen=True)
class TrainSettings:
    iterations: PositiveInt = setting(4, "Steps.")
    rate: float = setting(0.5, "Speed.")
    seed: int = setting(0, "Of the random numbers.")
    fail: Literal["", "bad", "error", "disk", "memory"] = setting("", "How to fail.")


@dataclass(frozen=True)
class PointsSettings:
    seed: int = setting(0, "Of the random numbers.")


def _poses(job: Job) -> None:
    assert job.source is not None
    text = "".join(path.read_text(encoding="utf-8") for path in sorted(job.source.glob("*.txt")))
    (job.out / "text.txt").write_text(text * job.settings.repeat, encoding="utf-8")
    if "odd" in text:
        job.warn("something is odd")


def _train(job: Job) -> None:
    match job.settings.fail:
        case "bad":
            raise BadInput(f"{job.inputs['poses']}: found nothing, expected something. Do something.")
        case "error":
            raise ValueError("first line\nsecond line")
        case "disk":
            raise OSError(28, "No space left on device", str(job.out / "field"))
        case "memory":
            raise MemoryError
    for step in range(job.settings.iterations):
        job.progress(step + 1, job.settings.iterations, "training", loss=1.0 / (step + 1))
        job.safe_point()
    text = (job.inputs["poses"] / "text.txt").read_text(encoding="utf-8")
    (job.out / "field.txt").write_text(f"{text} {job.settings.iterations} {job.settings.rate} {job.settings.seed}", encoding="utf-8")


def _points(job: Job) -> None:
    job.say("some points", points=3)
    (job.out / "points.ply").write_text((job.inputs["train"] / "field.txt").read_text(encoding="utf-8"), encoding="utf-8")


TOYS = (
    Stage("poses", 1, PosesSettings, (), _poses, reads_source=True),
    Stage("train", 1, TrainSettings, ("poses",), _train),
    Stage("points", 1, PointsSettings, ("train",), _points),
)
