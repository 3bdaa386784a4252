"""The child's side of `pipeline.executors.child`: it reads requests from standard input, and answers on standard output."""

import os
import sys
import time
import traceback
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from pipeline.decide import survey
from pipeline.errors import BadInput, CorruptArtifact, DiskFull, Interrupted, PipelineError, RunLocked, TooLittleMemory, UsageError
from pipeline.executors.local import execute_alone
from pipeline.executors.memory import Limit, resident
from pipeline.executors.pipes import Channel, end_with
from pipeline.failures import history, interruption_in, translated
from pipeline.interrupt import stopping
from pipeline.library_output import warnings_for_users
from pipeline.run import Run
from pipeline.runner import run_stages
from pipeline.sharing import take_over
from pipeline.stage import Job, Stage, settings_from
from pipeline.text import printable


class Program(Protocol):
    """The workflow's part, unknown to the engine.

    stages  in order
    """

    @property
    def stages(self) -> Sequence[Stage]: ...

    def prepare(self, run: Path, scene: dict[str, Any], memory: int | None) -> list[str]:
        """Make the run of a scene, or bring its settings up to date; returns warnings, also of stages in this much memory. Raises PipelineError."""

    def describe(self, run: Path) -> dict[str, Any]:
        """What fleet.json shows of a run as it is now: "metrics", "bytes", "verdict", "result"."""

    def needs(self, run: Path, stage: str, device: str, memory: int | None) -> tuple[int, int | None]:
        """Bytes that a stage which runs next writes at its peak in this much memory, and that it takes, by what those before it made; None: not known."""

    def is_finished(self, run: Path) -> bool:
        """Whether the pages about a run are there and newer than its stages."""

    def finish(self, run: Path) -> None:
        """Write the pages about a run whose stages are done."""


class _Channel(Channel):
    """The pipes to the parent."""

    def say(self, stage: str, text: str, event: str = "message") -> None:
        self.send({"event": event, "stage": stage, "text": text, "time": time.time()})


def serve(program: Program) -> None:
    """Do what the parent asks for, until it asks for the end."""
    channel = _Channel()
    end_with(channel.receive()["parent"])
    while (request := channel.receive())["kind"] != "end":
        with warnings_for_users(partial(channel.say, request.get("stage") or "", event="warning")):
            try:
                answer = {"ok": True, **_answer(program, request, channel)}
            except Exception as error:
                answer = {"ok": False, **_failure(error)}
        channel.send({"event": "result", **answer})
    sys.stderr.flush()
    os._exit(0)  # libraries that crash while they are unloaded do no harm


def _answer(program: Program, request: dict[str, Any], channel: _Channel) -> dict[str, Any]:
    if request["kind"] == "job":
        return _job_done(next(stage for stage in program.stages if stage.name == request["stage"]), request["job"], channel)
    path = Path(request["run"])
    if request["kind"] == "prepare":
        for text in program.prepare(path, request["scene"], request["memory"]):
            channel.say("", text, "warning")
        found = _survey(program, path)
        return {"stages": found, "finished": program.is_finished(path), **_estimates(program, path, found, request, channel), **program.describe(path)}
    if request["kind"] == "finish":
        program.finish(path)
        return {"resident": resident(), **program.describe(path)}
    name = request["stage"]
    stage = next(each for each in program.stages if each.name == name)
    if request.get("donor") and take_over(_opened(program, path), stage, Path(request["donor"])):
        channel.say(name, f"{name}: adopted from {Path(request['donor']).name}")
    memory = None if request["memory"] is None else Limit(request["memory"], "its share of the worker's memory")
    run = _opened(program, path)
    outcome = run_stages(run, program.stages, only=name, device=request["device"], memory=memory, report=channel.send, execute=execute_alone)[0]
    surveyed = _survey(program, path)
    made = next(each for each in surveyed if each["name"] == name)
    return {**made, "action": outcome.action, **_estimates(program, path, surveyed, request, channel), **program.describe(path)}


def _job_done(stage: Stage, asked: dict[str, Any], channel: _Channel) -> dict[str, Any]:
    """Run a stage as `SideBySide.execute` asks for it: its parent holds the run's lock, and publishes what is made."""
    sources = [Path(path) for path in asked["sources"]]
    with stopping() as stop:
        try:
            job = Job(
                settings=settings_from(stage.settings, asked["settings"], where=stage.name),
                inputs={need: Path(folder) for need, folder in asked["inputs"].items()},
                source=sources[0] if sources else None,
                also=sources[1:],
                out=Path(asked["out"]),
                work=Path(asked["work"]),
                device=asked["device"],
                memory=None if asked["memory"] is None else Limit(*asked["memory"]),
                stage=stage.name,
                report=channel.send,
                stop=stop,
            )
            return {"usage": asdict(execute_alone(stage, job)), "facts": job.facts}
        except (Exception, KeyboardInterrupt) as error:
            failure = interruption_in(error, stop()) or translated(error, stage.name, Path(asked["out"]))
            facts = {name: getattr(failure, name) for name in ("number", "needed", "files", "details") if hasattr(failure, name)}
            about = {"error": type(failure).__name__, "facts": facts, "text": str(failure), "trace": "".join(traceback.format_exception(error))}
            return {**about, "ok": False, "kind": "error"}


def _opened(program: Program, path: Path) -> Run:
    return Run.open(path, stages=frozenset(stage.name for stage in program.stages))


def _estimates(program: Program, path: Path, surveyed: Sequence[dict[str, Any]], request: dict[str, Any], channel: _Channel) -> dict[str, Any]:
    """Estimated disk and memory of the next stage, whose inputs exist. Where the estimate fails, the stage is admitted without one, with a message."""
    name = next((found["name"] for found in surveyed if not found["fresh"]), None)
    if name is None:
        return {}
    stage, facts = next(each for each in program.stages if each.name == name), request["next"]
    try:
        space, memory = program.needs(path, name, facts["device"] if stage.uses_device else "cpu", facts["memory"])
        return {"space": {name: space}, "memory": {} if memory is None else {name: memory}}
    except Exception as error:
        channel.say(name, f"{name}: its need cannot be estimated ({type(error).__name__}: {printable(str(error), 300)})")
        return {}


def _survey(program: Program, path: Path) -> list[dict[str, Any]]:
    """The stages of a run, whether each is up to date, and what it took."""
    stages = []
    for decision in survey(program.stages, _opened(program, path)):
        made = decision.manifest
        facts = {} if made is None else {"seconds": made.seconds, "cpu_seconds": made.cpu_seconds, "peak_memory": made.peak_memory, "digest": made.digest}
        stages.append({"name": decision.stage, "fresh": decision.fresh, "reason": decision.reason, **facts})
    return stages


def _failure(error: Exception) -> dict[str, Any]:
    """A failure as `pipeline.fleet.failure` judges it."""
    kinds = {TooLittleMemory: "refused", RunLocked: "locked", DiskFull: "disk", Interrupted: "stopped"}
    kind = next((word for cls, word in kinds.items() if isinstance(error, cls)), None)
    if kind is None and any(isinstance(cause, MemoryError) or type(cause).__name__ == "OutOfMemoryError" for cause in history(error)):
        kind = "memory"
    if kind is None:
        kind = "input" if isinstance(error, (BadInput, UsageError, CorruptArtifact)) else "error"
    text = str(error) if isinstance(error, PipelineError) else f"{type(error).__name__}: {error}"
    return {"kind": kind, "text": text, "needed": getattr(error, "needed", None)}
