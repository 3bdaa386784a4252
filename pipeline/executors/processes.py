"""Workers of a fleet on this machine: children of this process, and a thread for each task."""

import queue
import threading
import time
from collections.abc import Sequence
from typing import Any

from pipeline.executors.child import Children, Report
from pipeline.fleet.workers import Message, Task, Worker

PROGRESS_SECONDS = 0.5  # between two reports of a task's progress


class Processes:
    """One worker: this machine.

    module  what a child runs: it calls `serving.serve`
    """

    executor = "local"
    queued = False

    def __init__(self, module: str, worker: Worker) -> None:
        self.worker = worker
        self._children = Children(module, worker.capacity)
        self._messages: queue.SimpleQueue[Message] = queue.SimpleQueue()

    def alive(self) -> Sequence[Worker]:
        return (self.worker,)

    def start(self, task: Task) -> None:
        threading.Thread(target=self._work, args=(task,), name=f"task {task.number}", daemon=True).start()

    def stop(self, task: Task) -> None:
        self._children.stop(str(task.request["run"]))

    def receive(self, timeout: float) -> list[Message]:
        return received(self._messages, timeout)

    def close(self) -> None:
        self._children.close()

    def _work(self, task: Task) -> None:
        def report(event: dict[str, Any]) -> None:
            self._messages.put(Message(task.number, "event", event))

        gpus = () if task.gpu is None else (task.gpu,)
        result = self._children.work(task.request, without_haste(report), cores=task.cores, gpus=gpus)
        self._messages.put(Message(task.number, "result", result))


def received(messages: queue.SimpleQueue[Message], timeout: float) -> list[Message]:
    """All that has come; after at most so many seconds if nothing has."""
    found = []
    try:
        found.append(messages.get(timeout=timeout))
        while True:
            found.append(messages.get_nowait())
    except queue.Empty:
        return found


def without_haste(report: Report, seconds: float = PROGRESS_SECONDS) -> Report:
    """Passes events on, but progress that comes within so many seconds of the last one's."""
    last = -seconds

    def passed(event: dict[str, Any]) -> None:
        nonlocal last
        now = time.monotonic()
        if event.get("event") == "progress":
            if now - last < seconds:
                return
            last = now
        report(event)

    return passed
