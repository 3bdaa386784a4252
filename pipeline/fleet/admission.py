"""Which waiting scenes begin, and on which workers: a stage has to fit into the free memory, slots and devices.

    sum of what is admitted     at no time more than a worker's memory
    what does not fit now       has a worker reserved: stages that begin there meanwhile leave space for it, so that it waits only for those that run already
    what fits nowhere           gets the largest worker alone; the caller lowers its demand to that
"""

from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass

from pipeline.fleet.workers import Demand, Task, Worker

Place = tuple[Worker, int | None, int | None]  # with the bytes and the device that a stage has of it


@dataclass
class _Kept:
    """A worker that is kept for a scene."""

    who: int  # its number
    memory: int  # bytes that it waits for
    since: int  # the number of the first task that may have begun after this


class Admission:
    """The used part of each worker. Scenes ask in the order in which they may begin."""

    def __init__(self) -> None:
        self._tasks: dict[str, dict[int, Task]] = defaultdict(dict)
        self._kept: dict[str, _Kept] = {}
        self._workers: Sequence[Worker] = ()
        self._next = 0
        self._full: set[bool] = set()
        self._too_large: dict[bool, int] = {}

    def take(self, task: Task) -> None:
        self._tasks[task.worker][task.number] = task
        self._next = max(self._next, task.number + 1)

    def give(self, task: Task) -> None:
        self._tasks[task.worker].pop(task.number, None)

    def look(self, workers: Sequence[Worker], waiting: Collection[int]) -> None:
        """Begin a pass over the scenes of these numbers. Reservations for others, or of workers that have gone, end."""
        alive = {worker.name for worker in workers}
        self._workers = workers
        self._kept = {name: kept for name, kept in self._kept.items() if name in alive and kept.who in waiting}
        self._full, self._too_large = set(), {}

    def waited_for(self) -> set[int]:
        """The numbers of the scenes that have a reserved worker: they come first."""
        return {kept.who for kept in self._kept.values()}

    def place(self, who: int, demand: Demand, *, avoided: Collection[str] = (), preferred: str | None = None) -> Place | None:
        """Where a scene may begin; None where it fits on no worker now.

        avoided    workers that are taken where no other is large enough
        preferred  the worker that is taken if the scene fits on it, else the one with least to do
        """
        if demand.uses_gpu in self._full or (demand.memory or 0) >= self._too_large.get(demand.uses_gpu, 2**63):
            return None
        large = [worker for worker in self._workers if _memory(worker, demand) <= (worker.memory or 0)]
        chosen = [worker for worker in large if worker.name not in avoided] or large
        cramped = []
        for worker in sorted(chosen, key=lambda each: (each.name != preferred, len(self._tasks[each.name]) / each.capacity)):
            has_slot, gpu = self._slot(worker, demand)
            if has_slot and self._has_memory(worker, who, _memory(worker, demand)):
                self._kept = {name: kept for name, kept in self._kept.items() if kept.who != who}
                return worker, None if worker.memory is None else _memory(worker, demand), gpu
            if has_slot:
                cramped.append(worker)
        if cramped:
            self._keep(who, demand, cramped)
            if demand.memory is not None and not avoided:
                self._too_large[demand.uses_gpu] = demand.memory
        elif len(chosen) == len(self._workers):
            self._full.add(demand.uses_gpu)
        return None

    def _slot(self, worker: Worker, demand: Demand) -> tuple[bool, int | None]:
        """Whether a worker may run one stage more, and on which device."""
        tasks = self._tasks[worker.name].values()
        if demand.uses_gpu and worker.gpus:
            free = sorted({*worker.gpus} - {task.gpu for task in tasks})
            return bool(free), free[0] if free else None
        return sum(task.gpu is None for task in tasks) < worker.slots, None

    def _has_memory(self, worker: Worker, who: int, memory: int) -> bool:
        if worker.memory is None:
            return True
        tasks = self._tasks[worker.name].values()
        if sum(task.memory or 0 for task in tasks) + memory > worker.memory:
            return False
        kept = self._kept.get(worker.name)
        if kept is None or kept.who == who:
            return True
        return sum(task.memory or 0 for task in tasks if task.number >= kept.since) + memory + kept.memory <= worker.memory

    def _keep(self, who: int, demand: Demand, workers: Sequence[Worker]) -> None:
        """Reserve the worker with most free memory; a reservation stays."""
        for worker in self._workers:
            kept = self._kept.get(worker.name)
            if kept is not None and kept.who == who:
                kept.memory = _memory(worker, demand)
                return
        free = [worker for worker in workers if worker.name not in self._kept]
        if free:
            worker = max(free, key=lambda each: (each.memory or 0) - sum(task.memory or 0 for task in self._tasks[each.name].values()))
            self._kept[worker.name] = _Kept(who, _memory(worker, demand), self._next)


def _memory(worker: Worker, demand: Demand) -> int:
    """Bytes that a stage has of a worker; 0 where its limit is not known."""
    found = worker.share_of_memory if demand.memory is None else demand.memory
    return 0 if worker.memory is None else found or 0
