"""A workflow of toy stages for testing the command line in a blink, and a way to call it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import pytest
from msgspec import Meta

from efficientnerf.settings import PositiveInt, setting
from pipeline.errors import BadInput
from pipeline.stage import Job, Stage
from tests.workflows.command import Result
from workflows.asset import Workflow
from workflows.cli.main import main


@pytest.fixture
def enerf(capfd: pytest.CaptureFixture[str], request: pytest.FixtureRequest) -> Callable[..., Result]:
    """enerf("run", ...) in this process, on the toy workflow where the test has `toys`."""
    workflow = Workflow(TOYS, request.getfixturevalue("toys").parent / "presets") if "toys" in request.fixturenames else None

    def call(*arguments: object) -> Result:
        capfd.readouterr()
        code = main([str(argument) for argument in arguments], workflow)
        out, err = capfd.readouterr()
        return Result(code, out, err)

    return call


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


@pytest.fixture
def toys(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A source for the toy workflow, with presets beside it."""
    presets = tmp_path / "presets"
    presets.mkdir()
    (presets / "preview.toml").write_text('description = "Toy."\n[train]\niterations = 3\n', encoding="utf-8")
    (presets / "tiny.toml").write_text('description = "Smaller toy."\n[train]\niterations = 1\nrate = 2\n', encoding="utf-8")
    monkeypatch.setattr("workflows.cli.device.cuda_device_count", lambda: 0)
    source = tmp_path / "source"
    source.mkdir()
    (source / "a.txt").write_text("words", encoding="utf-8")
    return source
