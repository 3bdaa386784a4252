"""Kill, signal and stop runs at many moments, run them again each time, and compare the artifacts with those of an undisturbed run.

Each round has a run folder of its own, new or with an older artifact of every stage that has to be replaced. It is hit in one stage after the other, each
time followed by the same command, until it is done; then its artifacts are compared with the undisturbed ones and `.work` has to be empty.

    moment   at a random time of a stage, or before a random one of its file operations (trap.py)
    signal   SIGKILL to the process alone or to its children too; SIGTERM; SIGINT once or twice; SIGSTOP, then SIGCONT
    code     SIGTERM gives 143, SIGINT 130; a second run of the folder of a stopped one gives 5

Only SIGKILL counts as a kill; every fourth hit is another signal, of a stage that was killed before.
"""

import random
import shutil
import signal
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TextIO

from benchmarks.torture import processes, report
from benchmarks.torture.comparison import Expected, differences
from benchmarks.torture.processes import Child
from benchmarks.torture.sources import Source
from benchmarks.torture.trap import Armed, Operation, Trap

ENGINE = "engine"  # an aim that is no stage: the run's own files, between and around stages
METHODS = ("KILL",) * 6 + ("TERM", "INT", "INT INT", "STOP")
SHARE_FRESH = 10  # one round in so many is made with the real command
SHARE_VERIFIED = 5


@dataclass
class Prepared:
    """A source, and what is known of its undisturbed run; `older` has another artifact of every stage."""

    source: Source
    expected: Expected
    seconds: dict[str, float]
    operations: list[Operation]
    older: Path

    @property
    def stages(self) -> tuple[str, ...]:
        """In order."""
        return tuple(self.expected.digests)


@dataclass
class Hit:
    """One disturbance.

    aim     the stage that was meant; stage is the one that was hit
    moment  "time" or "call"
    place   of a call: kind and path
    code    of the exit, negative for a signal
    wrong   what was not as it has to be
    """

    round: int
    source: str
    aim: str
    signal: str
    moment: str
    whom: str
    stage: str = ""
    place: str = ""
    code: int = 0
    resumed: bool = False
    wrong: list[str] = field(default_factory=list)


class Rounds:
    """The rounds of one worker. Hits and rounds are written to `book`, an object on each line."""

    def __init__(self, folder: Path, prepared: Sequence[Prepared], seed: int, book: TextIO, workflow: Any = None) -> None:
        """workflow: of the command line, that of `workflows.asset` by default"""
        self.folder, self.prepared, self.book, self.workflow = folder, prepared, book, workflow
        self.random = random.Random(seed)
        self.kills = self.rounds = 0
        self.hits: Counter[str] = Counter()
        self.killed: set[str] = set()
        self.groups: list[Child] = []
        folder.mkdir(parents=True)

    def until(self, kills: int) -> None:
        while self.kills < kills:
            self.round(self.prepared[self.rounds % len(self.prepared)], kills - self.kills)

    def round(self, prepared: Prepared, most: int = 10**9) -> list[str]:
        """A run that is hit twice in every stage and finished then; returns what was wrong in the end."""
        run = self.folder / f"round_{self.rounds}"
        replaces = self.random.random() < 0.5
        fresh = self.rounds % SHARE_FRESH == SHARE_FRESH - 1
        if replaces:
            shutil.copytree(prepared.older, run, symlinks=True)
        before = self.kills
        for aim in self._aims(prepared.stages):
            if self.kills - before >= most:
                break
            self._hit(prepared, run, aim, fresh=fresh)
        wrong = self._end(prepared, run, fresh=fresh)
        report.record(self.book, {"event": "round", "round": self.rounds, "source": prepared.source.kind, "replaces": replaces, "fresh": fresh, "wrong": wrong})
        if not wrong:
            shutil.rmtree(run)
        self.rounds += 1
        return wrong

    def _aims(self, stages: Sequence[str]) -> list[str]:
        """Two for each stage and one more for the two that were hit least, in order; the engine's own files in between."""
        least = sorted(stages, key=lambda stage: (self.hits[stage], self.random.random()))[:2]
        aims = [stage for stage in stages for _ in range(3 if stage in least else 2)]
        aims.insert(self.random.randrange(len(aims)), ENGINE)
        return [ENGINE, *aims]

    def _hit(self, prepared: Prepared, run: Path, aim: str, *, fresh: bool) -> None:
        name = self.random.choice(METHODS if aim in self.killed else METHODS[:1])  # killed before it meets anything else
        moment = "time" if name == "STOP" or self.random.random() < 0.4 else "call"
        whom = "leader" if name == "TERM" or (name == "KILL" and self.random.random() < 0.3) else "group"
        hit = Hit(self.rounds, prepared.source.kind, aim, name, moment, whom)
        armed, due = self._moment(prepared, run, hit)
        child = self._start(prepared.source, run, armed, fresh=fresh)
        while child.alive() and not due(child) and not (armed and armed.fired):
            child.listen(0.002)
        if not child.alive() and not (armed and armed.fired):
            child.end()
            if child.code != 0:
                self._record(hit, child, [f"it ended with {child.code} before it was hit: {child.errors.strip()[:300]}"])
            return  # it was done before the moment came
        if armed and armed.fired:
            stage, kind, path = armed.place
            hit.place = f"{kind} {stage}: {Path(path).name}"
        else:
            hit.moment = "time"
        self._act(hit, child, prepared, run, sent=bool(armed and armed.fired))

    def _moment(self, prepared: Prepared, run: Path, hit: Hit) -> tuple[Armed | None, Callable[[Child], bool]]:
        """The trap, if it is a file operation, and whether the time has come; also when the stage is over, so that no moment is waited for in vain."""
        aim, stages = hit.aim, prepared.stages
        place = -1 if aim == ENGINE else stages.index(aim)
        share = self.random.uniform(0.0, 0.9)

        def over(child: Child) -> bool:
            return place >= 0 and (aim in child.seconds or any(stages.index(stage) > place for stage in child.started))

        if hit.moment == "call":
            kinds = sorted({operation.kind for operation in prepared.operations if operation.stage == aim})
            kind = self.random.choice(kinds)
            count = max(operation.number for operation in prepared.operations if (operation.stage, operation.kind) == (aim, kind))
            # The first ones rather than the last: a run that is resumed does not do all of them again.
            number = 1 + int(count * self.random.random() ** 2)
            action = f"{hit.whom}:{_number(hit.signal)}"
            armed = Armed(Trap(number, aim, (kind,), action), run, prepared.source.folder, self.folder / "state")
            return armed, over
        if aim == ENGINE:
            return None, lambda child: time.monotonic() - child.began > 0.25 * share
        seconds = prepared.seconds[aim]
        return None, lambda child: over(child) or (aim in child.started and time.monotonic() - child.started[aim] >= share * seconds)

    def _act(self, hit: Hit, child: Child, prepared: Prepared, run: Path, *, sent: bool) -> None:
        """Send what has to be sent, wait for the end, and judge it."""
        wrong: list[str] = []
        child.listen()
        began = bool(child.events)
        hit.stage = child.stage or ("between stages" if began else "start")
        if not sent:
            if child.armed is not None:
                child.armed.disarm()
            child.signal(_number(hit.signal), group=hit.whom == "group")
        if hit.signal == "INT INT":
            time.sleep(self.random.uniform(0.0, 0.05))
            child.signal(signal.SIGINT, group=True)
        if hit.signal == "STOP":
            wrong += self._second_run(child, prepared, run)
            child.signal(signal.SIGCONT, group=True)
            if self.random.random() < 0.8:
                child.listen(self.random.uniform(0.0, 0.2))
                child.signal(signal.SIGKILL, group=True)
        child.end()
        if hit.signal == "INT" and not sent and child.armed is not None and child.armed.fired:
            hit.signal = "INT INT"  # the trap was quicker than its end
        wrong += _judged(hit, child, began, prepared.stages[-1])
        self.kills += child.code == -signal.SIGKILL
        if child.code == -signal.SIGKILL:
            self.killed.add(hit.stage)
        if hit.signal != "KILL" and child.leftover():
            wrong.append("a child process lives on")
        self.hits[hit.stage] += 1
        if self.random.randrange(SHARE_VERIFIED) == 0 and (run / "run.json").exists():
            verified = processes.start(["verify", str(run)], self.folder / "verify.txt", workflow=self.workflow)
            if verified.end() != 0:
                wrong.append(f"verify ended with {verified.code}: {verified.errors.strip()[:300]}")
        self._record(hit, child, wrong)

    def _second_run(self, child: Child, prepared: Prepared, run: Path) -> list[str]:
        """What is wrong with a second run while the first is stopped."""
        if not child.stage:
            return []  # it may have no lock yet, or none any more
        second = processes.start(prepared.source.arguments(run), self.folder / "second.txt", workflow=self.workflow)
        return [] if second.end() == 5 else [f"a second run next to a stopped one ended with {second.code}: {second.errors.strip()[:300]}"]

    def _record(self, hit: Hit, child: Child, wrong: list[str]) -> None:
        hit.code, hit.resumed, hit.wrong = child.code or 0, child.resumed, wrong
        if wrong:
            print(f"WRONG: {hit}", flush=True)
        report.record(self.book, {"event": "hit", **asdict(hit)})

    def _start(self, source: Source, run: Path, armed: Armed | None, *, fresh: bool) -> Child:
        child = processes.start(source.arguments(run), self.folder / "errors.txt", armed, fresh=fresh, workflow=self.workflow)
        self.groups.append(child)
        return child

    def _end(self, prepared: Prepared, run: Path, *, fresh: bool) -> list[str]:
        """Run to the end and compare."""
        child = self._start(prepared.source, run, None, fresh=fresh)
        wrong = [] if child.end() == 0 else [f"the last run ended with {child.code}: {child.errors.strip()[:500]}"]
        wrong += differences(run, prepared.expected)
        wrong += ["a process of an earlier run lives on" for group in self.groups if group.leftover(10.0)]
        self.groups.clear()
        if wrong:
            print(f"WRONG: round {self.rounds} of {prepared.source.kind} in {run}: {'; '.join(wrong)}", flush=True)
        return wrong


def _number(name: str) -> int:
    return int(signal.Signals[f"SIG{name.split()[0]}"])


def _judged(hit: Hit, child: Child, began: bool, last: str) -> list[str]:
    """What is wrong with how a run ended."""
    summary = child.events[-1] if child.events and child.events[-1].get("event") == "summary" else {}
    done = child.code == 0 and summary.get("ok") is True
    all_done = last in child.seconds or any(event.get("event") == "stage_skipped" and event["stage"] == last for event in child.events)
    default = not began or all_done  # signals have their usual effect before the engine listens, and after
    alone = child.code == 3 and "its process was ended by SIGKILL" in child.errors  # that of a stage which ran next to others
    good = {
        "KILL": child.code == -signal.SIGKILL or alone or (done and hit.moment == "time"),  # it may end just before the signal
        "TERM": child.code == 143 or done or (default and child.code == -signal.SIGTERM),
        "INT": child.code == 130 or done or (default and child.code == -signal.SIGINT),
        "INT INT": child.code in (130, -signal.SIGINT) or done,
        "STOP": child.code == -signal.SIGKILL or done,
    }[hit.signal]
    wrong = [] if good and "hung:" not in child.errors else [f"it ended with {child.code} after {hit.signal}: {child.errors.strip()[-300:]}"]
    if hit.signal != "KILL" and "Traceback" in child.errors and not (default and (child.fresh or hit.signal == "INT INT")):
        wrong.append(f"a traceback: {child.errors.strip()[-300:]}")
    return wrong
