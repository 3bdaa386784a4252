"""A fleet without processes: what the scheduler alone takes, in memory and in seconds a task."""

from __future__ import annotations

import resource
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.fleet.child import STAGES
from pipeline.executors.local import peak_memory
from pipeline.fleet.scheduler import Scheduler, StageOf, states_for
from pipeline.fleet.state import NAME, Scene
from pipeline.fleet.workers import Message, Task, Worker

TASKS = len(STAGES) + 2  # of a scene: also prepare and finish
SPACE = 2**20  # bytes that each stage says it writes: every start looks at the disk


class Sleeping:
    """Workers whose stages take some milliseconds of the clock and write a byte."""

    executor = "simulated"
    queued = False

    def __init__(self, folder: Path, workers: int, slots: int, seconds: float) -> None:
        self.folder, self.seconds = folder, seconds
        self._workers = [Worker(f"tcp://machine{number}:1", slots, 2**34, slots=slots) for number in range(workers)]
        self._running: list[tuple[float, Task]] = []

    def alive(self) -> list[Worker]:
        return self._workers

    def start(self, task: Task) -> None:
        self._running.append((time.monotonic() + self.seconds, task))

    def stop(self, task: Task) -> None:
        raise AssertionError("nothing is stopped here")

    def receive(self, timeout: float) -> list[Message]:
        if self._running:
            time.sleep(max(0.0, min(self._running[0][0] - time.monotonic(), timeout)))
        now = time.monotonic()
        over = [task for until, task in self._running if until <= now]
        self._running = [(until, task) for until, task in self._running if until > now]
        return [Message(task.number, "result", self._answer(task)) for task in over]

    def close(self) -> None:
        pass

    def _answer(self, task: Task) -> dict[str, Any]:
        if task.request["kind"] == "prepare":
            stages = [{"name": stage.name, "fresh": False} for stage in STAGES]
            return {"ok": True, "stages": stages, "finished": False, "space": {stage.name: SPACE for stage in STAGES}}
        if task.request["kind"] == "finish":
            return {"ok": True}
        (self.folder / f"{task.number}").write_bytes(b"x")
        left = {stage.name: SPACE for stage in STAGES[1 + [each.name for each in STAGES].index(task.request["stage"]) :]}
        return {"ok": True, "name": task.request["stage"], "fresh": True, "seconds": self.seconds, "cpu_seconds": 0.0, "peak_memory": 1, "space": left}


def simulate(scenes: int, workers: int, slots: int = 2, seconds: float = 0.005) -> dict[str, Any]:
    """Run the fleet; processor time is that of the scheduler, with fleet.json, alone."""
    with tempfile.TemporaryDirectory() as name:
        fleet = Path(name)
        (fleet / "bytes").mkdir()
        before = peak_memory()
        states = states_for([Scene(f"scene-{number:05d}", (f"/shoots/{number:05d}",)) for number in range(scenes)], None)
        busy, began = _busy(), time.monotonic()
        found = Scheduler(fleet, states, [StageOf(stage.name) for stage in STAGES], Sleeping(fleet / "bytes", workers, slots, seconds)).run()
        spent, took = _busy() - busy, time.monotonic() - began
        assert found.totals.done == scenes
        return {
            "scenes": scenes, "workers": workers, "tasks": scenes * TASKS, "seconds": took, "cpu_seconds": spent, "cpu_seconds_a_task": spent / scenes / TASKS,
            "peak_memory": peak_memory(), "peak_memory_before": before, "fleet_json_bytes": (fleet / NAME).stat().st_size,
        }  # fmt: skip


def _busy() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime
