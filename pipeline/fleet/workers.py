"""What stages of a fleet run on, as the scheduler sees it: workers with room, tasks for them, and what comes back."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol


@dataclass(frozen=True)
class Worker:
    """A process, here or elsewhere, that runs stages in children of its own.

    cores   that its stages share
    memory  bytes that its stages share; None: no limit is known
    gpus    numbers of its CUDA devices; a stage has one to itself
    slots   stages without a device that run at a time
    """

    name: str
    cores: int
    memory: int | None = None
    gpus: tuple[int, ...] = ()
    slots: int = 1

    @property
    def capacity(self) -> int:
        """Stages that run at a time."""
        return self.slots + len(self.gpus)

    @property
    def share_of_cores(self) -> int:
        """Of each stage."""
        return max(1, self.cores // self.capacity)

    @property
    def share_of_memory(self) -> int | None:
        """Of each stage that states no need of its own."""
        return None if self.memory is None else self.memory // self.capacity


@dataclass(frozen=True)
class Demand:
    """What a stage takes of a worker.

    memory  bytes; None: the worker's share
    """

    uses_gpu: bool = False
    memory: int | None = None


@dataclass(frozen=True)
class Task:
    """A request for a child (`pipeline.executors.child.Children.work`), with what it was given of a worker."""

    number: int
    worker: str
    request: Mapping[str, Any]
    cores: int
    memory: int | None = None
    gpu: int | None = None


@dataclass(frozen=True)
class Message:
    """An event of a task, or its result: the last that is heard of it. "kind" is "lost" where its worker has gone, "unheard" where nobody knows."""

    task: int
    kind: Literal["event", "result"]
    content: dict[str, Any] = field(default_factory=dict)


class Workers(Protocol):
    """An executor of fleets. Its methods are called by one thread.

    queued  whether its workers are jobs of a queue: the first may be hours in coming
    """

    executor: str
    queued: bool

    def alive(self) -> Sequence[Worker]:
        """Those that take tasks now."""

    def start(self, task: Task) -> None:
        """Begin with a task; its messages come by `receive`."""

    def stop(self, task: Task) -> None:
        """Ask a task to stop at its next safe point; its result comes as ever."""

    def receive(self, timeout: float) -> list[Message]:
        """What has come, after at most so many seconds if nothing has."""

    def close(self) -> None:
        """End all that still runs."""


class Room:
    """What of each worker is taken. Memory is admitted by what stages may take, so that together they never take more than there is."""

    def __init__(self) -> None:
        self._tasks: dict[str, dict[int, Task]] = defaultdict(dict)

    def take(self, task: Task) -> None:
        self._tasks[task.worker][task.number] = task

    def give(self, task: Task) -> None:
        self._tasks[task.worker].pop(task.number, None)

    def on(self, worker: str) -> Sequence[Task]:
        return tuple(self._tasks[worker].values())

    def place(self, demand: Demand, workers: Sequence[Worker], preferred: str | None = None) -> tuple[Worker, int | None, int | None] | None:
        """(worker, memory, device) for a demand; None where no worker has room now. Of those with room the preferred one, else the one with least to do."""
        for worker in sorted(workers, key=lambda each: (each.name != preferred, len(self._tasks[each.name]) / each.capacity)):
            tasks = self._tasks[worker.name].values()
            memory = worker.share_of_memory if demand.memory is None else demand.memory
            if worker.memory is not None and memory is not None and sum(task.memory or 0 for task in tasks) + memory > worker.memory:
                continue
            if demand.uses_gpu and worker.gpus:
                free = sorted({*worker.gpus} - {task.gpu for task in tasks})
                if free:
                    return worker, memory, free[0]
            elif sum(task.gpu is None for task in tasks) < worker.slots:
                return worker, memory, None
        return None
