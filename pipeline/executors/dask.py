"""Workers of a fleet on Dask distributed (extra `fleet`): processes here or on other machines that share the fleet's folder.

The scheduler of the fleet admits stages; Dask carries them to the worker that was chosen, and says which workers there are. A task occupies a thread of its
worker while a child runs the stage. Devices are the resource GPU of Dask's workers (`dask worker --resources GPU=2`).
"""

import contextlib
import logging
import queue
import secrets
import threading
import time
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any

from pipeline.errors import BadInput, StageFailed, UsageError
from pipeline.executors.child import Children
from pipeline.executors.processes import received, without_haste
from pipeline.fleet.workers import Message, Task, Worker

# Kind -> module and class of the clusters that may be asked for by name.
CLUSTERS = {
    "local": ("distributed", "LocalCluster"),
    "ssh": ("distributed", "SSHCluster"),
    "slurm": ("dask_jobqueue", "SLURMCluster"),
    "pbs": ("dask_jobqueue", "PBSCluster"),
    "lsf": ("dask_jobqueue", "LSFCluster"),
    "sge": ("dask_jobqueue", "SGECluster"),
    "htcondor": ("dask_jobqueue", "HTCondorCluster"),
    "oar": ("dask_jobqueue", "OARCluster"),
}
GPU = "GPU"
ABSENT_SECONDS = 2.0  # that a worker may be missing before its tasks are lost
GONE_SECONDS = 60.0  # that the connection to Dask's scheduler may be cut
CONNECT_SECONDS = 60.0
SUBMIT_SECONDS = 120.0  # without a worker before jobs are asked of a queue again: those before have ended, by their time limit
LOOK_SECONDS = 1.0  # between a worker's checks whether its task is still wanted
PROGRESS_SECONDS = 2.0  # between two reports of a task's progress: they pass through Dask's scheduler
# Defaults for clusters that are started here; the user's configuration overrides them. Workers wait for children, of which Dask's profiler sees nothing:
# it took 3.5 % of a core in each worker and as much in the scheduler's process (docs/experiments/fleet.md).
DASK_DEFAULTS = {
    "distributed": {
        "worker": {"profile": {"enabled": False}, "memory": {"monitor-interval": "1s"}},
        "admin": {"system-monitor": {"interval": "5s"}, "tick": {"interval": "200ms"}},
    }
}


class DaskWorkers:
    """The workers of a Dask cluster.

    module   what a child runs: it calls `serving.serve`
    address  of a scheduler that runs; None: a cluster is started, and ended with this
    kind     of the cluster to start, one of CLUSTERS
    options  of the cluster's class; "jobs" is how many jobs are asked of a queue
    slots    stages without a device that run at a time on each worker
    """

    executor = "dask"

    def __init__(self, module: str, *, address: str | None = None, kind: str = "local", options: Mapping[str, Any] | None = None, slots: int = 1) -> None:
        distributed = _imported("distributed")
        for name in ("distributed", "distributed.client"):  # what becomes of workers is reported by the fleet
            logging.getLogger(name).setLevel(logging.CRITICAL)
        self.module, self.slots = module, slots
        self.queued = address is None and CLUSTERS[kind][0] == "dask_jobqueue"
        options = dict(options or {})
        self._jobs = options.pop("jobs", 1)
        self._cluster = None if address is not None else _started(kind, options, self._jobs)
        try:
            self._client = distributed.Client(address or self._cluster, timeout=CONNECT_SECONDS, set_as_default=False)
        except (OSError, ValueError) as error:
            raise BadInput(f"--scheduler {address}: no Dask scheduler answers ({error}). Start one: dask scheduler") from None
        self._topic = f"enerf-fleet-{secrets.token_hex(8)}"
        self._messages: queue.SimpleQueue[Message] = queue.SimpleQueue()
        self._futures: dict[int, tuple[Task, Any]] = {}
        self._absent: dict[str, float] = {}
        self._heard = self._worker_seen = time.monotonic()
        self._client.subscribe_topic(self._topic, self._event)

    def alive(self) -> Sequence[Worker]:
        """Also reports tasks whose worker has gone as lost: Dask would wait for it to come back."""
        try:
            # Not scheduler_info(), whose answer others of the client's own questions may replace by a shorter one.
            found = self._client.sync(self._client.scheduler.identity, n_workers=-1, callback_timeout=CONNECT_SECONDS)["workers"]
        except (OSError, ValueError, TypeError, KeyError, AttributeError, TimeoutError):  # of a connection that is cut
            found = None
        now = time.monotonic()
        if found is None or self._client.status != "running":
            if now - self._heard > GONE_SECONDS:
                raise StageFailed("the scheduler of Dask has gone. Start it, and give the fleet's command again: what is done is kept.")
            return ()
        self._heard = now
        self._worker_seen = now if found else self._worker_seen
        if self.queued and self._cluster is not None and now - self._worker_seen > SUBMIT_SECONDS:
            self._cluster.scale(jobs=self._jobs)  # those that still wait in the queue are not asked for twice
            self._worker_seen = now
        for number, (task, future) in list(self._futures.items()):
            if task.worker in found:
                self._absent.pop(task.worker, None)
            elif now - self._absent.setdefault(task.worker, now) > ABSENT_SECONDS:
                self._finish(number, {"ok": False, "kind": "lost", "text": f"its worker {task.worker} has gone."})
                future.cancel(force=True)
        return [self._worker(address, facts) for address, facts in found.items() if facts.get("status", "running") == "running"]

    def start(self, task: Task) -> None:
        plain = {"number": task.number, "request": dict(task.request), "cores": task.cores, "gpu": task.gpu, "most": self.slots + 1}
        future = self._client.submit(
            _work, plain, self._topic, self.module, key=f"{self._topic}-{task.number}", workers=[task.worker], allow_other_workers=False,
            resources=None if task.gpu is None else {GPU: 1}, retries=0, pure=False,
        )  # fmt: skip
        self._futures[task.number] = (task, future)
        future.add_done_callback(lambda done: self._done(task.number, done))

    def stop(self, task: Task) -> None:
        with contextlib.suppress(OSError, ValueError):  # of a worker that has gone: its tasks are lost
            self._client.run(_stop, self.module, str(task.request["run"]), workers=[task.worker], wait=False, on_error="ignore")

    def receive(self, timeout: float) -> list[Message]:
        return received(self._messages, timeout)

    def close(self) -> None:
        """A cluster that was started for this is ended, with what still runs on it; on another's workers tasks are cancelled, and stop at a safe point."""
        for _, future in self._futures.values():
            future.cancel(force=True)
        self._futures.clear()
        self._client.close(timeout=10)
        if self._cluster is not None:
            self._cluster.close(timeout=10)

    def _worker(self, address: str, facts: Mapping[str, Any]) -> Worker:
        threads, gpus = int(facts["nthreads"]), int(facts.get("resources", {}).get(GPU, 0))
        return Worker(address, threads, int(facts.get("memory_limit") or 0) or None, tuple(range(gpus)), max(1, min(self.slots, threads - gpus)))

    def _event(self, event: tuple[float, Any]) -> None:
        _, message = event
        self._messages.put(Message(message["task"], "event", message["event"]))

    def _done(self, number: int, future: Any) -> None:
        try:
            result = future.result()
        except Exception as error:  # cancelled: by Dask, whose scheduler has gone
            result = {"ok": False, "kind": "unheard", "text": f"nothing more is heard of it ({type(error).__name__})."}
        self._finish(number, result)

    def _finish(self, number: int, result: dict[str, Any]) -> None:
        if self._futures.pop(number, None) is not None:  # else it was heard of before
            self._messages.put(Message(number, "result", result))


def _imported(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        raise UsageError(f"{name} is not installed, which a fleet on Dask needs. Install it: pip install 'efficientnerf[fleet]'") from None


def _started(kind: str, options: dict[str, Any], jobs: int) -> Any:
    """A cluster of this kind, with its workers asked for."""
    module, name = CLUSTERS[kind]
    cluster_type = getattr(_imported(module), name)
    config = _imported("dask").config
    if DASK_DEFAULTS not in config.defaults:
        config.update_defaults(DASK_DEFAULTS)
    if kind == "ssh":
        _imported("asyncssh")  # Dask says so late
    if kind == "local":
        options = {"threads_per_worker": 1, "dashboard_address": None, **options}
    if module == "dask_jobqueue":
        options = {"processes": 1, **options}
        if options["processes"] != 1:  # dask_jobqueue forgets no job of several, and asks for no other when they have ended
            raise UsageError(f"--cluster {kind}: processes: found {options['processes']!r}, expected 1. Ask for more jobs instead (jobs).")
    try:
        cluster = cluster_type(**options)
        if module == "dask_jobqueue":
            cluster.scale(jobs=jobs)
    except (TypeError, ValueError, OSError, RuntimeError) as error:
        raise UsageError(f"--cluster {kind}: could not be started: {type(error).__name__}: {error}. Its options are those of {module}.{name}.") from None
    return cluster


# On a worker.
_children: dict[str, Children] = {}
_lock = threading.Lock()


def _work(task: dict[str, Any], topic: str, module: str) -> dict[str, Any]:
    """Do a task in a child of this worker; its events go to the topic."""
    from distributed import get_worker  # an extra
    from distributed.worker import thread_state  # an extra

    worker, key = get_worker(), thread_state.key
    with _lock:
        children = _children.setdefault(module, Children(module, task["most"]))
    over = threading.Event()

    def watch() -> None:
        """Stop the stage once its task is not wanted: Dask does not end what runs."""
        while not over.wait(LOOK_SECONDS):
            state = worker.state.tasks.get(key)
            if state is None or state.state in ("cancelled", "resumed", "forgotten", "released"):
                children.stop(str(task["request"]["run"]))
                return

    threading.Thread(target=watch, name=f"watch of {key}", daemon=True).start()
    try:
        report = without_haste(lambda event: worker.log_event(topic, {"task": task["number"], "event": event}), PROGRESS_SECONDS)
        return children.work(task["request"], report, cores=task["cores"], gpus=() if task["gpu"] is None else (task["gpu"],))
    finally:
        over.set()


def _stop(module: str, run: str) -> None:
    if module in _children:
        _children[module].stop(run)
