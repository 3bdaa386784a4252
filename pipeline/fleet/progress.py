"""A scene of a fleet while it is run: the stages that are left, and what is known of what they take."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

from pipeline.executors.memory import size_text
from pipeline.fleet.failure import HEADROOM, Attempts
from pipeline.fleet.state import LONGEST_LINE, MOST_LINES, SceneState, StageState, Verdict
from pipeline.fleet.workers import Task
from pipeline.text import printable

PREPARATION = 512 * 2**20  # bytes that preparing a run takes at most, and writing its pages


@dataclass
class Progress:
    """A scene of a fleet while it is run."""

    state: SceneState
    number: int  # its place in the manifest
    todo: list[str] | None = None  # stages that are not up to date, in order; None before its run is prepared
    finished: bool = False  # whether its pages are written
    task: Task | None = None
    stop_reason: str | None = None
    not_before: float = 0.0
    last_worker: str | None = None
    attempts: Attempts = field(default_factory=Attempts)
    lines: list[str] = field(default_factory=list)
    space: Mapping[str, int] = field(default_factory=dict)  # bytes that its stages write, by name
    memory: Mapping[str, int] = field(default_factory=dict)  # bytes that they take, of those for which that is known

    @property
    def what(self) -> str:
        """The stage to run next, or "prepare" or "finish"."""
        return "prepare" if self.todo is None else self.todo[0] if self.todo else "finish"

    def bytes_needed(self) -> int | None:
        """Bytes that it takes next; None where unknown: a worker's share."""
        if self.attempts.memory is not None:
            return self.attempts.memory
        if not self.todo:
            return PREPARATION
        estimate = self.memory.get(self.what)
        return None if estimate is None else int(HEADROOM * estimate)

    def too_little(self, memory: int | None) -> str | None:
        """A warning where these bytes, all of the largest worker's, are less than the stage's estimate."""
        need = self.memory.get(self.what, 0)
        if memory is None or need <= memory or self.attempts.memory is not None:
            return None
        return f"{self.what}: takes about {size_text(need)}, and no worker has more than {size_text(memory)}: it runs alone there, with less."

    def warn(self, text: str) -> bool:
        """Add a warning; returns whether it is a new one."""
        if text in self.state.warnings:
            return False
        self.state.warnings = [*self.state.warnings, text][:MOST_LINES]
        return True

    def record(self, result: Mapping[str, Any], known: Collection[str]) -> None:
        """Read an answer about the run: what its known stages took, what they made, and what the next takes."""
        for found in [*result.get("stages", []), *([result] if "fresh" in result else [])]:
            if found.get("name") not in known or not found.get("fresh"):
                continue
            worker = self.state.stages[found["name"]].worker if found["name"] in self.state.stages else None
            numbers = {name: found.get(name) or 0 for name in ("seconds", "cpu_seconds", "peak_memory")}
            self.state.stages[found["name"]] = StageState("done", worker=worker, **numbers)
        self.state.seconds = sum(stage.seconds for stage in self.state.stages.values() if stage.state == "done")
        self.space, self.memory = result.get("space") or self.space, result.get("memory") or self.memory
        if "metrics" in result:
            self.state.metrics = dict(result["metrics"] or {})
            self.state.bytes = int(result.get("bytes") or 0)
            self.state.verdict, self.state.result = (_verdict(result.get(name)) for name in ("verdict", "result"))


def _verdict(found: Mapping[str, Any] | None) -> Verdict | None:
    return None if found is None else Verdict(printable(found["grade"], 200), printable(found["summary"], 4 * LONGEST_LINE))
