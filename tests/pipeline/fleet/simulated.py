"""Workers without processes: tasks end when the test's clock says so, and workers come and go."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from pipeline.fleet import scheduler
from pipeline.fleet.scheduler import Scheduler, states_for
from pipeline.fleet.state import FleetState, Scene, SceneState
from pipeline.fleet.workers import Message, Task, Worker
from pipeline.stage import Stage
from tests.pipeline.toy import NoSettings

STAGES = ("poses", "train", "bake")
Answer = Callable[[Task], dict[str, Any] | None]


def done(task: Task, **facts: Any) -> dict[str, Any]:
    """The answer of a child whose work went well."""
    kind = task.request["kind"]
    if kind == "prepare":
        return {"ok": True, "stages": [{"name": name, "fresh": False} for name in STAGES], "finished": False, **facts}
    if kind == "stage":
        return {"ok": True, "name": task.request["stage"], "fresh": True, "seconds": 2.0, "cpu_seconds": 1.0, "peak_memory": 5, **facts}
    return {"ok": True, **facts}


@dataclass
class Simulated:
    """Follows `pipeline.fleet.workers.Workers`. Each call of `receive` ends the oldest tasks, one on each worker.

    answer  what a task answers; None: it goes on until it is stopped or its worker goes
    log     (scene, what, worker) of each task that was started, in order
    tasks   the same tasks themselves
    most    of memory and stages on each worker at a time, as it was seen
    """

    workers: list[Worker]
    answer: Answer = done
    executor: str = "simulated"
    log: list[tuple[str, str, str]] = field(default_factory=list)
    tasks: list[Task] = field(default_factory=list)
    running: dict[int, Task] = field(default_factory=dict)
    messages: list[Message] = field(default_factory=list)
    most: dict[str, tuple[int, int]] = field(default_factory=dict)
    between: Callable[[], None] = lambda: None
    closed: bool = False
    queued: bool = False

    def alive(self) -> list[Worker]:
        return list(self.workers)

    def start(self, task: Task) -> None:
        assert task.worker in {worker.name for worker in self.workers}
        assert not any(other.request["run"] == task.request["run"] for other in self.running.values()), "two at once on one run"
        self.running[task.number] = task
        self.tasks.append(task)
        self.log.append((scene_of(task), what(task.request), task.worker))
        mine = [other for other in self.running.values() if other.worker == task.worker]
        taken = (sum(other.memory or 0 for other in mine), len(mine))
        former = self.most.get(task.worker, (0, 0))
        self.most[task.worker] = (max(former[0], taken[0]), max(former[1], taken[1]))
        gpus = [other.gpu for other in mine if other.gpu is not None]
        assert len(gpus) == len(set(gpus)), "two stages on one device"

    def stop(self, task: Task) -> None:
        self._end(task, {"ok": False, "kind": "stopped", "text": "stopped."})

    def receive(self, timeout: float) -> list[Message]:
        self.between()
        ended: set[str] = set()
        for task in list(self.running.values()):
            if task.worker not in ended and (result := self.answer(task)) is not None:
                ended.add(task.worker)
                self._end(task, result)
        found, self.messages = self.messages, []
        return found

    def lose(self, name: str) -> None:
        """A worker dies, with all that it runs."""
        self.workers = [worker for worker in self.workers if worker.name != name]
        for task in [task for task in self.running.values() if task.worker == name]:
            self._end(task, {"ok": False, "kind": "lost", "text": f"its worker {name} has gone."})

    def close(self) -> None:
        self.closed = True

    def _end(self, task: Task, result: dict[str, Any]) -> None:
        if self.running.pop(task.number, None) is not None:
            self.messages.append(Message(task.number, "result", result))


def scene_of(task: Task) -> str:
    return str(task.request["run"]).rpartition("/")[2]


def what(request: Mapping[str, Any]) -> str:
    return str(request.get("stage") or request["kind"])


def scenes(count: int) -> list[Scene]:
    return [Scene(f"s{number}", (f"/shoots/{number}",)) for number in range(count)]


def hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    """The scheduler looks at its workers and writes its file whenever it may."""
    for name in ("LOOK_SECONDS", "WRITE_SECONDS", "WRITE_INTERVAL_RATIO", "LOCKED_PAUSE"):
        monkeypatch.setattr(scheduler, name, 0.0)


def run(fleet: Path, workers: Simulated, chosen: list[Scene], **more: Any) -> FleetState:
    fleet.mkdir(exist_ok=True)
    states = states_for(chosen, more.pop("former", None))
    stages = [Stage(name, 1, NoSettings, (), lambda job: None, uses_device=name != "poses") for name in STAGES]
    return Scheduler(fleet, states, stages, workers, **more).run()


def state_of(found: FleetState, name: str) -> SceneState:
    return next(scene for scene in found.scenes if scene.name == name)
