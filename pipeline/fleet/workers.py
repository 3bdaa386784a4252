"""The scheduler's view of its executor: workers with their capacity, tasks, and results."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol


@dataclass(frozen=True)
class Worker:
    """A process, here or elsewhere, that runs stages in children of its own."""

    name: str
    cores: int  # that its stages share
    memory: int | None = None  # bytes that its stages share; None: no limit is known
    gpus: tuple[int, ...] = ()  # numbers of its CUDA devices; a stage has one to itself
    slots: int = 1  # stages without a device that run at a time

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
    """What a stage takes of a worker."""

    uses_gpu: bool = False
    memory: int | None = None  # bytes; None: the worker's share


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
    """An event of a task, or its result, which comes last. Its "kind" is "lost" where the worker has gone, "unheard" where that is unknown."""

    task: int
    kind: Literal["event", "result"]
    content: dict[str, Any] = field(default_factory=dict)


class Workers(Protocol):
    """An executor of fleets. Its methods are called by one thread."""

    executor: str
    queued: bool  # whether its workers are jobs of a queue: the first may be hours in coming

    def alive(self) -> Sequence[Worker]:
        """Those that take tasks now."""

    def start(self, task: Task) -> None:
        """Begin with a task; its messages come by `receive`."""

    def stop(self, task: Task) -> None:
        """Ask a task to stop at its next safe point; its result still comes."""

    def receive(self, timeout: float) -> list[Message]:
        """Messages that have come; waits at most so many seconds for one."""

    def close(self) -> None:
        """End all that still runs."""
