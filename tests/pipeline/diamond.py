"""A workflow in the shape of a diamond, whose stages of the middle run side by side; as a program, the child that they run in."""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pipeline.errors import BadInput, CorruptArtifact, TooLittleMemory
from pipeline.executors.serving import serve
from pipeline.run import Run
from pipeline.stage import Job, Stage, settings_dict

PATIENCE = 30.0  # seconds


@dataclass(frozen=True)
class TopSettings:
    text: str = "top"


@dataclass(frozen=True)
class MiddleSettings:
    """What a stage does: `meets` waits until the stages named have begun, and `does` says how it ends."""

    place: str = ""
    meets: tuple[str, ...] = ()
    does: str = "ends"


@dataclass(frozen=True)
class BottomSettings:
    pass


def run_top(job: Job) -> None:
    (job.out / "top.txt").write_text(job.settings.text)


def run_middle(job: Job) -> None:
    settings: MiddleSettings = job.settings
    text = (job.inputs["top"] / "top.txt").read_text()
    if settings.place:
        Path(settings.place, job.stage).write_text(f"{os.getpid()} {os.environ.get('OMP_NUM_THREADS')}")
    deadline = time.monotonic() + PATIENCE
    while not all(Path(settings.place, name).exists() for name in settings.meets):
        assert time.monotonic() < deadline, f"{job.stage} met nobody"
        time.sleep(0.01)
    job.progress(1, 2, f"{job.stage} works")
    job.record("memory", None if job.memory is None else job.memory.bytes)
    match settings.does:
        case "waits":
            while True:
                assert time.monotonic() < deadline, "nobody stopped it"
                job.safe_point()
                time.sleep(0.01)
        case "dies":
            os._exit(9)
        case "raises":
            raise ValueError("a library's words")
        case "bad input":
            raise BadInput("no such thing. Give another.")
        case "corrupt":
            raise CorruptArtifact("altered", ("top/top.txt",))
        case "too little memory":
            raise TooLittleMemory("needs more", 123)
    (job.out / f"{job.stage}.txt").write_text(f"{job.stage} of {text}")


def run_bottom(job: Job) -> None:
    (job.out / "all.txt").write_text(" ".join((job.inputs[name] / f"{name}.txt").read_text() for name in MIDDLE))


MIDDLE = ("left", "centre", "right")
STAGES = (
    Stage("top", 1, TopSettings, (), run_top),
    *(Stage(name, 1, MiddleSettings, ("top",), run_middle) for name in MIDDLE),
    Stage("bottom", 1, BottomSettings, ("top", *MIDDLE), run_bottom),
)
AFTER_LEFT = Stage("after_left", 1, MiddleSettings, ("top", "left"), run_middle)


def make_run(folder: Path, *, place: Path | None = None, meets: dict[str, tuple[str, ...]] | None = None, does: dict[str, str] | None = None) -> Run:
    """A run in which stages of the middle meet others and end as said."""
    settings = {stage.name: settings_dict(stage.settings()) for stage in (*STAGES, AFTER_LEFT)}
    for name in (*MIDDLE, AFTER_LEFT.name):
        settings[name] |= {"place": str(place or ""), "meets": list((meets or {}).get(name, ())), "does": (does or {}).get(name, "ends")}
    return Run.create(folder, None, settings)


class Diamond:
    """The child's program; what fleets ask for is not asked here."""

    stages = (*STAGES, AFTER_LEFT)
    prepare: Callable[..., list[str]]
    describe: Callable[..., dict[str, object]]
    needs: Callable[..., tuple[int, int | None]]
    is_finished: Callable[..., bool]
    finish: Callable[..., None]


if __name__ == "__main__":
    serve(Diamond())
