"""A workflow of toy stages, for testing the command line in a blink."""

import os
import signal
import subprocess
import sys
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta

from efficientnerf.settings import Auto, PositiveInt, setting
from pipeline.errors import BadInput
from pipeline.stage import Job, Stage


@dataclass(frozen=True)
class PosesSettings:
    format: Literal["auto", "photographs"] = setting("auto", "What the source is.")
    strict: bool = setting(False, "Whether to refuse.")
    allow_outside: bool = setting(False, "Whether to allow.")
    llff_factor: PositiveInt | Auto = setting("auto", "Which images.", advanced=True)
    max_image_size: PositiveInt = setting(1000, "Longest side.")
    repeat: Annotated[int, Meta(ge=1, le=9)] = setting(1, "How often the text is repeated.")


@dataclass(frozen=True)
class TrainSettings:
    iterations: PositiveInt = setting(4, "Steps.")
    rate: float = setting(0.5, "Speed.")
    seed: int = setting(0, "Of the random numbers.")
    fail: Literal["", "bad", "error", "disk", "memory", "greedy", "ended", "slow", "noisy"] = setting("", "How to fail.")


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
        case "greedy" | "ended":
            _take_all_memory(job)
        case "noisy":
            _make_noise()
        case "slow":
            _wait_for(job.out.parents[5] / "go on", job)
    for step in range(job.settings.iterations):
        job.progress(step + 1, job.settings.iterations, "training", loss=1.0 / (step + 1))
        job.safe_point()
    text = (job.inputs["poses"] / "text.txt").read_text(encoding="utf-8")
    (job.out / "field.txt").write_text(f"{text} {job.settings.iterations} {job.settings.rate} {job.settings.seed}", encoding="utf-8")


def _make_noise() -> None:
    """What libraries say in every way, and a warning for users."""
    import logging
    import threading

    from efficientnerf.backends import Notice

    warnings.warn("NOISE overflow encountered in exp", RuntimeWarning, stacklevel=1)
    warnings.warn("NOISE of an old function", DeprecationWarning, stacklevel=1)
    os.write(2, b"NOISE TIFFjpeg_progress_monitor: exceeds\n")
    logging.getLogger("a.library").warning("NOISE of a logger")
    thread = threading.Thread(target=lambda: 1 / 0, name="NOISE")
    thread.start()
    thread.join()
    subprocess.run([sys.executable, "-c", "import os; os.write(2, b'NOISE of a child\\n')"], check=True)
    warnings.warn("for users: the cache is damaged", Notice, stacklevel=1)


def _take_all_memory(job: Job) -> None:
    """Touch half of what may be taken, where the system allows 384 MiB more; or be ended by it."""
    import resource  # not on Windows

    assert job.memory is not None
    job.say(f"{job.memory.bytes} {os.getpid()}")
    if job.settings.fail == "ended" and job.memory.bytes > 2**29:
        os.kill(os.getpid(), signal.SIGKILL)
    taken = next(int(line.split()[1]) for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmSize:"))
    former = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (1024 * taken + 384 * 2**20, former[1]))
    try:
        bytearray(job.memory.bytes // 2)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, former)


def _wait_for(path: Path, job: Job) -> None:
    """Until the test says so; of which process that is, it learns beside it."""
    path.with_name(f"{job.stage} in {os.getpid()}").touch()
    while not path.exists():
        job.safe_point()
        time.sleep(0.02)


def _points(job: Job) -> None:
    job.say("some points", points=3)
    (job.out / "points.ply").write_text((job.inputs["train"] / "field.txt").read_text(encoding="utf-8"), encoding="utf-8")


TOYS = (
    Stage("poses", 1, PosesSettings, (), _poses, reads_source=True),
    Stage("train", 1, TrainSettings, ("poses",), _train),
    Stage("points", 1, PointsSettings, ("train",), _points),
)
