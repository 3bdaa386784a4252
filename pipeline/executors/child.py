"""Runs stages in child processes: a crash in a library, or the system ending a process that takes too much memory, fails one stage and not the others.

A child works for one run (`pipeline.executors.serving` is its side) and is kept for the run's next stage: what it has imported and compiled is used again.
One that prepares runs goes on to the next run, until a run whose stages begin takes it over; so does one whose run is done, unless it holds much memory.
Parent and child speak lines of JSON (`pipeline.executors.pipes`):

    to the child    {"kind": "prepare" | "stage" | "job" | "finish" | "end", ...}, see `Children.work`
    from the child  the stages' events, then {"event": "result", "ok", ...}

Each child leads a group of processes. It ends with its parent, and whatever it has started ends with it.
"""

import contextlib
import json
import os
import signal
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from pipeline.executors.cores import VARIABLES
from pipeline.executors.pipes import Child
from pipeline.text import printable

Event = dict[str, Any]
Report = Callable[[Event], None]
Kind = tuple[int, tuple[int, ...]]

LAST_LINES = 20  # of standard error that are kept
LONGEST_LINE = 500
IDLE_SECONDS = 5.0  # seconds that a child without work is kept
MAX_KEPT_BYTES = 2**30  # bytes that the child of a finished run may hold and be used again: for small scenes starting another takes a large part of the time
GRACE = 20.0  # seconds that a child has to reach a safe point once it is asked to stop


class _Child(Child):
    """One process and its pipes, the leader of a group. Its result is {"ok": False, "kind": "died", "signal", "text"} where it ended without one."""

    def __init__(self, module: str, kind: Kind) -> None:
        super().__init__(module, group=True, env=_environment(*kind))
        self.kind = kind  # cores that it computes on, and CUDA devices that it sees
        self.run: str | None = None  # that it works for or is kept for; None: any
        self.idle_since: float | None = None  # None while it works
        self.stopping = False
        self.write({"parent": os.getpid()})

    def work(self, request: Mapping[str, Any], report: Report) -> Event:
        assert self.process.stdout is not None
        if request["kind"] == "prepare":
            self.lines.clear()  # of the run before
        self.write(request)
        while line := self.process.stdout.readline():
            try:
                message = json.loads(line)
            except ValueError:  # half a line before its end
                break
            if message.get("event") == "result":
                return {**message, "lines": self._last_lines()}
            report(message)
        return self._died()

    def stop(self) -> None:
        """Ask it to stop at its next safe point; after GRACE seconds it is killed."""
        if not self.stopping:
            self.stopping = True
            with contextlib.suppress(ProcessLookupError):
                self.process.send_signal(signal.SIGTERM)
            timer = threading.Timer(GRACE, self.kill)
            timer.daemon = True
            timer.start()

    def end(self) -> None:
        """Let it end; it has no work."""
        self.write({"kind": "end"})
        with contextlib.suppress(OSError):
            assert self.process.stdin is not None
            self.process.stdin.close()
        if not self._ended():
            self.kill()
        self._reap()

    def kill(self) -> None:
        """It, and all that it has started."""
        if self.process.returncode is None:  # its number is not another's before it is reaped
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self.process.pid, signal.SIGKILL)

    def _died(self) -> Event:
        if not self._ended():
            self.kill()
        self._reap()
        code = self.process.returncode
        number = -code if code < 0 else None
        how = f"was ended by {signal.Signals(number).name}" if number is not None else f"ended with exit code {code} and no answer"
        return {"event": "result", "ok": False, "kind": "died", "signal": number, "text": f"its process {how}.", "lines": self._last_lines()}

    def _ended(self) -> bool:
        """Whether it has ended, or does within GRACE seconds; it is not reaped yet, so that its group's number is still its own."""
        deadline = time.monotonic() + GRACE
        while not self._has_ended():
            if time.monotonic() > deadline:
                return False
            time.sleep(0.005)
        return True

    def _has_ended(self) -> bool:
        if hasattr(os, "waitid"):
            return os.waitid(os.P_PID, self.process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None
        if self.process.poll() is None:  # macOS, before Python 3.13: looking reaps, and what it left behind is killed before its group's number is another's
            return False
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid, signal.SIGKILL)
        return True

    def _reap(self) -> None:
        """Once it has ended, or was killed."""
        self.kill()  # what it started and left behind
        self.close()

    def _last_lines(self) -> list[str]:
        return [printable(line.strip(), LONGEST_LINE) for line in list(self.lines)[-LAST_LINES:]]


class Children:
    """The children of a worker. Used from any number of threads; one works for a run at a time."""

    def __init__(self, module: str, most: int) -> None:
        self.module = module  # what a child runs: it calls `serving.serve`
        self.most = most  # children with a run that are kept at a time, with those that have no work
        self._children: list[_Child] = []
        self._lock = threading.Lock()
        # A child dies with the thread that started it (prctl): one that lives as long as this process starts all of them.
        self._starter = ThreadPoolExecutor(1, thread_name_prefix="starter of stages")
        self._closed = False

    def work(self, request: Mapping[str, Any], report: Report, *, cores: int, gpus: Sequence[int] = ()) -> Event:
        """What a child answers to a request; never raises.

        request  {"kind": "prepare" | "stage" | "finish", "run": path, ...}; "prepare" with "scene" and "memory" (bytes or None), "stage" with "stage",
                 "device" and "memory"; or {"kind": "job", ...}, see `side_by_side`: "run" is any name of the child then
        """
        try:
            child = self._child(None if request["kind"] == "prepare" else str(request["run"]), (cores, tuple(gpus)))
        except OSError as error:
            return {"event": "result", "ok": False, "kind": "died", "signal": None, "text": f"no process could be started: {error.strerror}.", "lines": []}
        if child is None:
            return _stopped_result()
        try:
            answer = child.work(request, report)
        except BaseException:  # of `report`: the child has not come to an end
            child.kill()
            self._give_back(child, drop=True, free=False)
            raise
        if child.stopping and not answer["ok"]:
            answer = {**_stopped_result(), "lines": answer["lines"]} if answer.get("kind") == "died" else {**answer, "kind": "stopped"}
        held = answer.pop("resident", None)
        is_used_up = child.stopping or child.process.returncode is not None or answer.get("kind") == "memory"  # a new one has all of its memory
        is_free = held is not None and held <= MAX_KEPT_BYTES and not gpus  # its run is done, and it holds little memory: other runs may use it
        self._give_back(child, drop=is_used_up or (request["kind"] == "finish" and not is_free), free=is_free)
        return answer

    def stop(self, run: str) -> None:
        """Ask what works for this run to stop at its next safe point."""
        with self._lock:
            for child in self._children:
                if child.run == run and child.idle_since is None:
                    child.stop()

    def tidy(self, kept: float = IDLE_SECONDS) -> None:
        """End the children that have had no work for so many seconds."""
        now = time.monotonic()
        with self._lock:
            doomed = [child for child in self._children if child.idle_since is not None and now - child.idle_since >= kept - 0.1]
            self._remove(doomed)
        for child in doomed:
            child.end()

    def close(self) -> None:
        """Kill all of them."""
        with self._lock:
            self._closed = True
            for child in self._children:
                child.kill()
        self.tidy(0.0)

    def _child(self, run: str | None, kind: Kind) -> _Child | None:
        """A child for this run, or for the preparation of any, with these cores and devices: the run's own, else a free one, for starting another costs a
        second; else a new one. None once all are closed."""
        doomed: list[_Child] = []
        try:
            with self._lock:
                if self._closed:
                    return None
                idle = [child for child in self._children if child.idle_since is not None]
                doomed += [child for child in idle if child.run is not None and child.run == run and child.kind != kind]
                found = next((child for child in idle if child.run == run and child.kind == kind), None)
                if found is None:
                    doomed += [child for child in self._excess(idle) if child not in doomed]
                    found = next((child for child in idle if child.run is None and child.kind == kind), None)
                self._remove(doomed)
                if found is None:
                    found = self._starter.submit(_Child, self.module, kind).result()
                    self._children.append(found)
                found.run, found.idle_since = run, None
                return found
        finally:
            for child in doomed:
                child.end()

    def _excess(self, idle: Sequence[_Child]) -> list[_Child]:
        """The idle children of runs that exceed `most` once another is added, longest idle first."""
        kept = [child for child in self._children if child.run is not None]
        ordered = sorted((child for child in idle if child.run is not None), key=lambda child: child.idle_since or 0.0)
        return ordered[: max(0, len(kept) + 1 - self.most)]

    def _give_back(self, child: _Child, *, drop: bool, free: bool) -> None:
        """After its work: it ends, or waits for its run's next stage, or for that of any run."""
        with self._lock:
            child.idle_since = time.monotonic()
            child.run = None if free else child.run
            if drop:
                self._remove([child])
        if drop and child.process.returncode is None:
            child.end()
        timer = threading.Timer(IDLE_SECONDS, self.tidy)
        timer.daemon = True
        timer.start()

    def _remove(self, doomed: Sequence[_Child]) -> None:
        self._children = [child for child in self._children if child not in doomed]


def _stopped_result() -> Event:
    return {"event": "result", "ok": False, "kind": "stopped", "text": "stopped.", "lines": []}


def _environment(cores: int, gpus: tuple[int, ...]) -> dict[str, str]:
    """That of a child: numerical libraries compute on its cores, CUDA sees its devices."""
    found = {**os.environ, **dict.fromkeys(VARIABLES, str(cores))}
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    names = [name for name in visible.split(",") if name]
    found["CUDA_VISIBLE_DEVICES"] = ",".join(names[gpu] if gpu < len(names) else str(gpu) for gpu in gpus)
    return found
