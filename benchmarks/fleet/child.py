"""Stages that sleep and write a few bytes, with checkpoints, and the process that runs them."""

import hashlib
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.errors import Interrupted
from pipeline.executors.serving import serve
from pipeline.files import write_atomically
from pipeline.links import WORK
from pipeline.run import NAME, Run
from pipeline.stage import Job, Stage, settings_dict
from workflows.workflow import Workflow

CHILD = "benchmarks.fleet.child"
JOURNAL = "journal"  # in a run: a line for each step that was done, each stage that was begun or ended


@dataclass(frozen=True)
class SleepSettings:
    steps: int = 5
    seconds: float = 0.1
    word: str = ""


def _run(job: Job) -> None:
    """Each step hashes the one before; what is made of them is the same whether it was interrupted or not."""
    _note(job, "begun")
    checkpoint = job.work / "steps"
    lines = checkpoint.read_text().splitlines() if checkpoint.exists() else []
    before = "".join((folder / "made").read_text() for folder in job.inputs.values())
    for step in range(len(lines), job.settings.steps):
        time.sleep(job.settings.seconds)
        lines.append(hashlib.sha256(f"{job.stage} {job.settings.word} {before} {lines} {step}".encode()).hexdigest())
        write_atomically(checkpoint, "\n".join(lines).encode())
        _note(job, f"step {step}")
        job.progress(step + 1, job.settings.steps)
        job.safe_point()
    (job.out / "made").write_text("\n".join(lines))
    _note(job, "ended")


def _note(job: Job, what: str) -> None:
    """One write, appended: whoever is killed, the line is there or it is not."""
    run = next(folder for folder in job.work.parents if folder.name == WORK).parent
    published = "published" if (run / job.stage / "manifest.json").exists() else "-"
    with (run / JOURNAL).open("ab", buffering=0) as journal:
        journal.write(f"{job.stage} {published} {what}\n".encode())


STAGES = (
    Stage("first", 1, SleepSettings, (), _run),
    Stage("second", 1, SleepSettings, ("first",), _run),
    Stage("third", 1, SleepSettings, ("second",), _run),
)
WORKFLOW = Workflow(STAGES, Path(), CHILD)


class Sleepers:
    """`pipeline.executors.serving.Program` of these stages."""

    @property
    def stages(self) -> Sequence[Stage]:
        return STAGES

    def prepare(self, run: Path, scene: dict[str, Any], memory: int | None) -> list[str]:
        settings = {stage.name: settings_dict(SleepSettings(**{"word": scene["name"], **scene["settings"].get(stage.name, {})})) for stage in STAGES}
        if not (run / NAME).is_file():
            Run.create(run, None, settings)
        Run.open(run).update(settings=settings)
        return []

    def describe(self, run: Path) -> dict[str, Any]:
        return {"metrics": {}, "bytes": 0, "verdict": None}

    def space(self, run: Path, stage: str, memory: int | None) -> int:
        return 1

    def is_finished(self, run: Path) -> bool:
        return (run / "finished").exists()

    def finish(self, run: Path) -> None:
        write_atomically(run / "finished", b"")


if __name__ == "__main__":
    try:
        serve(Sleepers())
    except Interrupted:
        raise SystemExit(130) from None
