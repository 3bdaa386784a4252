"""Runs stages of one run at the same time, each in a child process, on the same cores; `pipeline.executors.serving` is the child's side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pipeline import errors
from pipeline.executors.child import Children
from pipeline.executors.local import Usage
from pipeline.stage import Job, Stage, settings_dict

RUN = "stages side by side"  # that all children work for


class FailureInChild(Exception):
    """The traceback of what a child raised, as its text: the cause of the error that is raised here."""


@dataclass
class SideBySide:
    """An executor for stages that do not need each other. Used from `jobs` threads at most; closed by `with`."""

    module: str  # what a child runs: it calls `serving.serve`
    jobs: int  # stages at a time
    cores: int  # that each of them may use: what one leaves idle the others take, and the last one has all of them
    need: Callable[[Stage], int | None]  # bytes that a stage takes at its peak; None: not known
    least: float = 0.0  # seconds that the stages before have taken for it to be worth it: each child takes some to begin

    def __post_init__(self) -> None:
        self._children = Children(self.module, self.jobs)

    def __enter__(self) -> SideBySide:
        return self

    def __exit__(self, *error: object) -> None:
        self._children.close()

    def execute(self, stage: Stage, job: Job) -> Usage:
        """Run the stage to its end, in a child that one before it may have left. Raises what it raised."""
        facts = {
            "settings": settings_dict(job.settings),
            "inputs": {need: str(folder) for need, folder in job.inputs.items()},
            "sources": [str(path) for path in job.sources.values()],
            "out": str(job.out),
            "work": str(job.work),
            "device": job.device,
            "memory": None if job.memory is None else [job.memory.bytes, job.memory.whose],
        }
        answer = self._children.work({"kind": "job", "run": RUN, "stage": stage.name, "job": facts}, job.pass_on, cores=self.cores)
        if not answer["ok"]:
            raise _error_of(stage.name, answer)
        job.facts |= answer["facts"]
        return Usage(**answer["usage"])

    def rest(self) -> None:
        """End the children, none of which works now: what follows has their memory."""
        self._children.tidy(0.0)

    def stop(self) -> None:
        """Ask all stages that run to stop at their next safe points."""
        self._children.stop(RUN)


def _error_of(stage: str, answer: dict[str, Any]) -> errors.PipelineError:
    text = str(answer["text"])
    if "error" not in answer:  # the process itself ended
        if answer["kind"] == "stopped":
            return errors.Interrupted()
        return errors.StageFailed(f"{stage}: {text} {' '.join(answer['lines'][-1:])}".rstrip())
    kind: Any = getattr(errors, answer["error"], errors.StageFailed)
    if kind is errors.Interrupted:
        return errors.Interrupted(answer["facts"]["number"], text)
    facts = {name: tuple(found) if isinstance(found, list) else found for name, found in answer["facts"].items()}  # JSON has no tuples
    made: errors.PipelineError = kind(text, **facts)
    made.__cause__ = FailureInChild(answer["trace"])
    return made
