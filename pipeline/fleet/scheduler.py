"""Runs the scenes of a fleet: the stages of each in order, those of different scenes concurrently where resources allow.

A scene's run is authoritative: published stages are never done again, whatever happens to this process. fleet.json reports the state to others.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pipeline.errors import Interrupted, RunLocked, StageFailed
from pipeline.executors.memory import size_text
from pipeline.fleet import forecast, requests
from pipeline.fleet.admission import Admission
from pipeline.fleet.failure import LOCKED_PAUSE, Attempts, remedy
from pipeline.fleet.progress import Progress
from pipeline.fleet.state import LONGEST_LINE, MOST_LINES, FleetState, FleetWord, Scene, SceneState, StageState, Totals, write_fleet
from pipeline.fleet.workers import Demand, Message, Task, Worker, Workers
from pipeline.stage import Stage
from pipeline.text import printable

Report = Callable[[dict[str, Any]], None]

WRITE_SECONDS = 1.0  # between two writings of fleet.json, and WRITE_INTERVAL_RATIO as long as one takes
WRITE_INTERVAL_RATIO = 20.0
LOOK_SECONDS = 1.0  # between two checks for requests, and for workers that came or went
LONGEST_ABSENCE = 300.0  # seconds that a fleet waits while it has no worker
REPORT_SECONDS = 30.0  # seconds before that is reported


class Scheduler:
    """One call of `enerf fleet`.

    fleet    its folder, whose lock is held
    states   all scenes, as they were before: done ones are checked again, quarantined ones left alone
    stages   of the workflow, in order
    device   "cpu" or "cuda"
    report   takes events, each with "scene": those of stages, and scene_done, scene_failed, scene_quarantined, retry
    written  called after each writing of fleet.json
    stop     returns the number of the signal that arrived, or None
    lost     returns why the fleet's lock is lost, or None
    """

    def __init__(
        self, fleet: Path, states: Sequence[SceneState], stages: Sequence[Stage], workers: Workers, *, device: str = "cpu",
        report: Report = lambda event: None, written: Callable[[FleetState], None] = lambda state: None,
        stop: Callable[[], int | None] = lambda: None, lost: Callable[[], str | None] = lambda: None,
    ) -> None:  # fmt: skip
        self.fleet = fleet
        self.stages = {stage.name: stage for stage in stages}
        self.workers = workers
        self.device = device
        self.state = FleetState(started=_now(), executor=workers.executor, slots=0, scenes=list(states))
        self._report, self._written, self._stop, self._lost = report, written, stop, lost
        self._all = {state.name: Progress(state, number) for number, state in enumerate(states)}
        self._open = [each for each in self._all.values() if each.state.state != "quarantined"]
        self._tasks: dict[int, Progress] = {}
        self._admission = Admission()
        self._alive: Sequence[Worker] = ()
        self._largest: int | None = None  # bytes of the largest worker; None where no limit is known
        self._next_number = 0
        self._next_write = self._next_look = 0.0
        self._worker_seen = time.monotonic()
        self._changed = True
        self._cancelled = self._ending = False
        for each in self._open:
            each.state.state, each.state.reason, each.state.stage, each.state.worker, each.state.attempts = "waiting", None, None, None, 0

    def run(self) -> FleetState:
        """Until every scene is done, failed or quarantined.

        Raises Interrupted; RunLocked where another took the fleet over; StageFailed where there are no workers: open scenes are left waiting.
        """
        number: int | None = None
        ended = True
        try:
            while self._left() and (number := self._stop()) is None and not self._cancelled:
                if self._look() or ended:  # progress frees no resources
                    self._admit()
                ended = False
                for message in self.workers.receive(0.5):
                    ended |= self._heed(message)
                self._write()
            self._wind_down()
        except StageFailed as error:  # nothing is heard of the tasks any more
            self._tasks.clear()
            self._wait_all()
            self.state.note = printable(str(error), 4 * LONGEST_LINE)
            self._write("interrupted")
            raise
        finally:
            self.workers.close()
        ending: FleetWord = "done" if self.state.exit_code == 0 else "failed"
        self._write("interrupted" if number is not None and self._open else "cancelled" if self._cancelled else ending)
        if number is not None and self._open:
            raise Interrupted(number)
        return self.state

    def _left(self) -> bool:
        """Whether scenes are open. What was requested at the last moment counts."""
        if not self._open:
            self._take_requests()
        return bool(self._open)

    def _look(self) -> bool:
        """Now and then: which workers there are, what was requested, whether the fleet is still ours. Returns whether the check was due."""
        now = time.monotonic()
        if now < self._next_look:
            return False
        self._next_look = now + LOOK_SECONDS
        if (why := self._lost()) is not None:
            raise RunLocked(why)
        self._alive = self.workers.alive()
        limits = [worker.memory for worker in self._alive]
        self._largest = None if None in limits else max((limit or 0 for limit in limits), default=None)
        self.state.slots = sum(worker.capacity for worker in self._alive)
        self._look_for_workers(now)
        self._take_requests()
        return True

    def _look_for_workers(self, now: float) -> None:
        """Report a lack of workers. Raises StageFailed where it has lasted too long; jobs of a queue may be hours in coming."""
        self._worker_seen = now if self._alive else self._worker_seen
        absent, minutes = now - self._worker_seen, f"{LONGEST_ABSENCE / 60:.0f} minutes"
        patience = "as long as it takes" if self.workers.queued else minutes
        note = f"no worker is there; one is waited for, {patience}" if not self._alive and absent >= REPORT_SECONDS else None
        if note != self.state.note:
            self.state.note, self._changed = note, True
            if note is not None:
                self._report({"time": time.time(), "event": "warning", "scene": "", "text": note})
        if absent > LONGEST_ABSENCE and not self.workers.queued and not self._tasks:  # one that takes no more tasks may still end those that it has
            what = f"{len(self._open)} scenes wait. Start workers, and give the fleet's command again: what is done is kept."
            raise StageFailed(f"{self.fleet}: no worker was there for {minutes}. {what}")

    def _take_requests(self) -> None:
        for request in requests.take(self.fleet):
            self._obey(request)

    def _obey(self, request: requests.Request) -> None:
        if request.do == "cancel" and request.scenes is None:
            self._cancelled = bool(self._open)
            return
        for name in request.scenes if request.scenes is not None else self._all:
            each = self._all.get(name)
            if each is None:
                continue
            if request.do == "retry" and each.state.state in ("failed", "quarantined"):
                each.state.state, each.state.reason, each.attempts, each.todo, each.stop_reason = "waiting", None, Attempts(), None, None
                self._open.append(each)
                self._changed = True
            if request.do == "cancel" and each in self._open:
                if each.task is not None:
                    each.stop_reason = "cancelled."
                    self.workers.stop(each.task)
                else:
                    self._give_up(each, "failed", "cancelled.")

    def _admit(self) -> None:
        """Start what fits: first what has waited for resources, then stages that use a device, then scenes that have begun, in the manifest's order."""
        now = time.monotonic()
        cramped: list[Progress] = []
        too_much = math.inf  # bytes to write for which the disk has no space
        waiting = {each.number: each for each in self._open if each.task is None and each.not_before <= now and self._has_its_share(each)}
        self._admission.look(self._alive, waiting)
        first = self._admission.waited_for()
        for each in sorted(waiting.values(), key=lambda each: (each.number not in first, not self._uses_gpu(each), each.todo is None, each.number)):
            place = self._admission.place(each.number, self._demand(each), avoided=each.attempts.lost_on, preferred=each.last_worker)
            need = each.space.get(each.what, 0)
            if place is not None and ((self._tasks and need >= too_much) or not self._has_disk(each, need)):
                too_much = min(too_much, need)  # where nothing runs each is tried: what it has written already counts
                cramped.append(each)
            elif place is not None:
                self._start(each, *place)
        for each in cramped if not self._tasks else ():  # nothing that runs will give any of it back
            shown = f"{each.what}: writes about {size_text(each.space[each.what])}; {size_text(forecast.free_space(self.fleet))} are free in {self.fleet}."
            self._give_up(each, "failed", f"{shown} Free some space, and go on.")

    def _has_disk(self, each: Progress, need: int) -> bool:
        """Whether the disk has space for so many bytes of its stage and what running stages will write: what they have written already is no longer free."""
        if not need:
            return True
        running = [(other, other.space.get(str(other.task.request.get("stage")), 0)) for other in self._tasks.values() if other.task]
        left = sum(max(0, need - forecast.written_in(self.fleet / other.state.run)) for other, need in [(each, need), *running])
        return left + forecast.RESERVE + forecast.RESERVE_PER_SCENE * len(self._all) <= forecast.free_space(self.fleet)

    def _uses_gpu(self, each: Progress) -> bool:
        return self.device == "cuda" and each.what in self.stages and self.stages[each.what].uses_device

    def _demand(self, each: Progress) -> Demand:
        """The scene's demand: its stage's, or all of the largest worker where that is less: the worker that had more may have gone."""
        memory = each.bytes_needed()
        if memory is not None and self._largest is not None:
            memory = min(memory, self._largest)
        return Demand(uses_gpu=self._uses_gpu(each), memory=memory)

    def _has_its_share(self, each: Progress) -> bool:
        """Whether the scene that makes the next artifact for this one, too, has done so, or never will."""
        donor = self._donor(each)
        return donor is None or donor.state.state not in ("waiting", "running") or (donor.todo is not None and each.what not in donor.todo)

    def _donor(self, each: Progress) -> Progress | None:
        return self._all.get(each.state.shares.get(each.what, ""))

    def _start(self, each: Progress, worker: Worker, memory: int | None, gpu: int | None) -> None:
        memory = each.attempts.memory if memory is None else memory
        request: dict[str, Any] = {"kind": each.what, "run": str(self.fleet / each.state.run), "next": {"device": self.device, "memory": self._largest}}
        if each.what == "prepare":
            request |= {"scene": asdict(each.state.scene()), "memory": worker.share_of_memory}
        elif each.what in self.stages:
            donor = self._donor(each)
            facts = {"stage": each.what, "device": self.device if self.stages[each.what].uses_device else "cpu", "memory": memory}
            request |= {"kind": "stage", "donor": None if donor is None else str(self.fleet / donor.state.run), **facts}
            if (text := each.too_little(memory)) is not None:
                each.warn(text)
                self._tell(each, "warning", text=text)
            each.state.stages.setdefault(each.what, StageState()).state = "running"
            each.state.stages[each.what].worker = worker.name
        self._next_number += 1
        each.task = Task(self._next_number, worker.name, request, worker.share_of_cores, memory, gpu)
        each.state.state, each.state.worker, each.last_worker = "running", worker.name, worker.name
        each.state.stage = each.what if each.what in self.stages else None
        each.lines = []
        self._tasks[each.task.number] = each
        self._admission.take(each.task)
        self._changed = True
        self.workers.start(each.task)

    def _heed(self, message: Message) -> bool:
        """Returns whether a task has ended."""
        each = self._tasks.get(message.task)
        if each is None or each.task is None:
            return False  # of a task that was given up
        if message.kind == "event":
            self._event(each, message.content)
            return False
        task, each.task = each.task, None
        del self._tasks[task.number]
        self._admission.give(task)
        self._changed = True
        each.record(message.content, self.stages)
        if message.content.get("ok"):
            self._done(each, task, message.content)
        else:
            self._failed(each, task, message.content)
        return True

    def _event(self, each: Progress, event: dict[str, Any]) -> None:
        text = printable(event.get("text") or "", LONGEST_LINE)
        if event.get("event") in ("message", "warning", "stage_failed") and text:
            each.lines = [*each.lines, text][-MOST_LINES:]
        self._changed |= event.get("event") == "warning" and each.warn(text)
        self._tell(each, event.pop("event", "message"), **event)

    def _done(self, each: Progress, task: Task, result: Mapping[str, Any]) -> None:
        kind = task.request["kind"]
        each.attempts, each.state.attempts, each.state.stage, each.state.reason = Attempts(), 0, None, None
        if kind == "prepare":
            # A stage that is up to date but for one before it is run, too: it is skipped at once where that gave the same again.
            each.todo = [found["name"] for found in result["stages"] if not found["fresh"]]
            each.finished = not each.todo and bool(result["finished"])
            for name in self.stages:
                each.state.stages.setdefault(name, StageState())
            for name in each.todo:
                each.state.stages[name].state = "waiting"
        elif kind == "stage" and each.todo:
            each.todo.pop(0)
        else:
            each.finished = True
        if each.finished:
            self._open.remove(each)
            each.state.state, each.state.worker, each.state.last_lines = "done", None, []
            self._tell(each, "scene_done", seconds=each.state.seconds)
        elif each.stop_reason is not None:
            self._give_up(each, "failed", each.stop_reason)

    def _failed(self, each: Progress, task: Task, result: Mapping[str, Any]) -> None:
        stage = task.request.get("stage")
        if stage in each.state.stages:
            each.state.stages[stage].state = "waiting"
        each.lines = [*each.lines, *(printable(line, LONGEST_LINE) for line in result.get("lines", []))][-MOST_LINES:]
        if each.stop_reason is not None:
            self._give_up(each, "failed", each.stop_reason)
            return
        if self._ending and result.get("kind") in ("stopped", "died", "lost", "unheard"):
            return
        now = time.monotonic()
        judged = remedy(
            stage or task.request["kind"], result, each.attempts, worker=task.worker,
            given=task.memory, largest=self._largest, now=now,
        )  # fmt: skip
        each.state.attempts = each.attempts.count
        if judged.action in ("failed", "quarantined"):
            if stage in each.state.stages:
                each.state.stages[stage].state = "failed"
            self._give_up(each, judged.action, judged.reason)
            return
        each.not_before = now + LOCKED_PAUSE if judged.action == "later" else 0.0
        each.state.state, each.state.reason, each.state.worker = "waiting", judged.reason[: 4 * LONGEST_LINE], None
        if judged.action == "again":  # a stage that was published all the same is skipped
            self._tell(each, "retry", text=judged.reason)

    def _give_up(self, each: Progress, state: str, reason: str) -> None:
        each.state.state = "failed" if state == "failed" else "quarantined"
        each.state.reason = printable(reason, 4 * LONGEST_LINE)
        each.state.last_lines, each.state.stage, each.state.worker = each.lines, None, None
        self._open.remove(each)
        self._changed = True
        self._tell(each, f"scene_{state}", text=reason)

    def _wind_down(self) -> None:
        """Stop what still runs, and wait for it."""
        self._ending = True
        for each in list(self._tasks.values()):
            assert each.task is not None
            self.workers.stop(each.task)
        while self._tasks:
            for message in self.workers.receive(0.5):
                self._heed(message)
            self._write()
        self._wait_all()

    def _wait_all(self) -> None:
        """Leave the open scenes to the next call."""
        for each in self._open:
            each.state.state, each.state.stage, each.state.worker = "waiting", None, None
            for stage in each.state.stages.values():
                stage.state = "waiting" if stage.state == "running" else stage.state

    def _write(self, ending: FleetWord | None = None) -> None:
        now = time.monotonic()
        if ending is None and (not self._changed or now < self._next_write):
            return
        self.state.state = ending or "running"
        self.state.note = self.state.note if ending in (None, "interrupted") else None
        self.state.updated, self.state.totals = _now(), Totals.of(self.state.scenes)
        self.state.forecast_seconds = 0.0 if ending is not None else forecast.forecast_seconds(self.state.scenes, list(self.stages), self.state.slots)
        write_fleet(self.fleet, self.state)
        self._written(self.state)
        self._changed = False
        self._next_write = now + max(WRITE_SECONDS, WRITE_INTERVAL_RATIO * (time.monotonic() - now))

    def _tell(self, each: Progress, event: str, **facts: Any) -> None:
        self._report({"time": time.time(), **facts, "event": event, "scene": each.state.name})


def states_for(scenes: Sequence[Scene], former: FleetState | None) -> list[SceneState]:
    """The state of each scene before it runs: that of the same scene in an earlier call, else waiting. A scene that has changed begins anew."""
    known = {} if former is None else {state.name: state for state in former.scenes}
    return [known[scene.name] if scene.name in known and known[scene.name].scene() == scene else SceneState.of(scene) for scene in scenes]


def _now() -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
