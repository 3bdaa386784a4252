"""Kill -9 `enerf run` at many moments, run it again each time, and compare the artifacts with those of an undisturbed run.

    python benchmarks/torture.py [--kills 30] [--images 12] [--json FILE]

Each round has a run folder of its own. It is killed in one stage after the other, each kill followed by `enerf run`, until it is done; then the
digests of all its artifacts are compared. Besides moments at random times:

    matching  while pairs of photographs are matched
    mp4       while the video is being written
    swap      while a new artifact takes the place of an older one: between the two renames, and after them
    publish   after an artifact was sealed, before it was renamed into the run

The last two are reached by a child process that kills itself after a certain rename.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
PHOTOGRAPHS = HERE.parent / "examples" / "still_life"
STAGES = ("poses", "train", "bake", "evaluate", "turntable", "mesh", "points")

# The tiny preset, with a video that takes long enough to be hit.
OPTIONS = ("--preset", "tiny", "--device", "cpu", "--set", "turntable.frames=12", "--set", "turntable.width=160", "--set", "turntable.height=120")

# argv: rename to die after, its number, what follows is for enerf. Renames are the steps by which artifacts are published.
SELF_KILLER = """
import os, signal, sys
from pipeline import files
target, after = sys.argv[1], sys.argv[2]
known = files.rename
def rename(source, destination):
    if after == "before" and destination.name == target and source.name == "out":
        os.kill(os.getpid(), signal.SIGKILL)
    known(source, destination)
    if (after == "aside" and destination.name == "old-" + target) or (after == "placed" and destination.name == target and source.name == "out"):
        os.kill(os.getpid(), signal.SIGKILL)
files.rename = rename
from workflows.cli.main import main
sys.exit(main(sys.argv[3:]))
"""


@dataclass
class Kill:
    """One kill: the moment that was intended, and the moment it hit."""

    round: int
    aim: str
    stage: str
    after: float
    hit: str = ""
    done: float = 0.0
    resumed: bool = False


@dataclass
class Child:
    """A running `enerf run --json` and its events so far."""

    process: subprocess.Popen[str]
    events: list[dict[str, Any]] = field(default_factory=list)
    started: dict[str, float] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    stage: str = ""
    errors: str = ""

    def listen(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with contextlib.suppress(ValueError):
                self._note(json.loads(line))

    def _note(self, event: dict[str, Any]) -> None:
        now, stage = time.monotonic(), event.get("stage", "")
        self.events.append(event)
        if event["event"] == "stage_started":
            self.started[stage], self.stage = now, stage
        elif event["event"] == "stage_done" and stage in self.started:
            self.seconds[stage] = now - self.started[stage]
            self.stage = ""


def start(arguments: Sequence[str], program: Sequence[str] = ("-m", "workflows.cli.main")) -> tuple[Child, threading.Thread]:
    command = [sys.executable, *program, *arguments]
    environment = {**os.environ, "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "1")}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True, env=environment)
    child = Child(process)
    thread = threading.Thread(target=child.listen, daemon=True)
    thread.start()
    return child, thread


def finish(child: Child, thread: threading.Thread) -> int:
    """Wait for the end; returns the exit code (negative: the signal)."""
    assert child.process.stderr is not None
    child.errors = child.process.stderr.read()
    code = child.process.wait()
    thread.join()
    child.process.stderr.close()
    if child.process.stdout is not None:
        child.process.stdout.close()
    return code


def complete(arguments: Sequence[str]) -> Child:
    """Run to the end; raises SystemExit with what the run said if it failed."""
    child, thread = start(arguments)
    if finish(child, thread) != 0:
        raise SystemExit(f"the run failed: {child.errors.strip()}")
    return child


def kill_when(arguments: Sequence[str], moment: Callable[[Child], bool], kill: Kill, run: Path) -> bool:
    """Start a run, kill -9 it and its children at the moment; returns whether it was still running. Notes where it was hit."""
    child, thread = start(arguments)
    begun = time.monotonic()
    while child.process.poll() is None and not moment(child):
        time.sleep(0.002)
    kill.after, kill.stage = time.monotonic() - begun, child.stage or "between stages"
    last = next((event for event in reversed(child.events) if event["event"] == "progress" and event["stage"] == child.stage), None)
    alive = child.process.poll() is None
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child.process.pid, signal.SIGKILL)
    finish(child, thread)
    kill.hit = "" if last is None else f"{last.get('text', '')} {last.get('done', 0):g}/{last.get('total', 0):g}".strip()
    kill.resumed = any(event["event"] == "stage_started" and event.get("resumed") for event in child.events)
    kill.done = sum((run / stage).is_dir() for stage in STAGES)
    return alive


def digests(run: Path) -> dict[str, str | None]:
    """The digest of each artifact, from its manifest."""
    found: dict[str, str | None] = {}
    for stage in STAGES:
        path = run / stage / "manifest.json"
        found[stage] = json.loads(path.read_text(encoding="utf-8"))["digest"] if path.is_file() else None
    return found


def at_share(stage: str, share: float, seconds: float) -> Callable[[Child], bool]:
    """So far into a stage, by time or by what it says of itself; also once a later stage has begun, so that no moment is waited for in vain."""
    place = STAGES.index(stage)

    def moment(child: Child) -> bool:
        begun = child.started.get(stage)
        if begun is not None and time.monotonic() - begun >= share * seconds:
            return True
        last = child.events[-1] if child.events else {}
        # The progress of training is that of the stage; elsewhere it begins anew with each part.
        if stage == "train" and last.get("stage") == stage and last["event"] == "progress" and last["done"] >= max(1, share * last["total"]):
            return True
        return any(STAGES.index(other) > place for other in list(child.started))

    return moment


def while_matching(child: Child) -> bool:
    return any(event["event"] == "progress" and "match" in event.get("text", "") and event.get("done", 0) > 0 for event in child.events[-3:])


def while_encoding(run: Path) -> Callable[[Child], bool]:
    """Once the file of the video is there under its temporary name."""

    def moment(child: Child) -> bool:
        if child.stage != "turntable":
            return False
        return any((run / ".work" / "turntable").glob("*/*/.turntable.mp4*")) or any((run / ".work" / "turntable").glob("*/*/turntable.mp4"))

    return moment


class Torture:
    """The rounds, and the book of what was killed where."""

    def __init__(self, folder: Path, source: Path, options: Sequence[str], seed: int) -> None:
        self.folder, self.source, self.options = folder, source, list(options)
        self.random = random.Random(seed)
        self.kills: list[Kill] = []
        self.bad: list[dict[str, Any]] = []
        self.runs = 0

    def undisturbed(self) -> None:
        """The reference, and how long each stage takes."""
        run = self.folder / "undisturbed"
        begun = time.monotonic()
        child = complete(self.arguments(run))
        self.total = time.monotonic() - begun
        self.seconds = child.seconds
        self.expected = digests(run)
        missing = [stage for stage, digest in self.expected.items() if digest is None]
        if missing:
            raise SystemExit(f"the undisturbed run made no {', '.join(missing)}")

    def arguments(self, run: Path) -> list[str]:
        return ["run", str(self.source), "--out", str(run), "--json", *self.options]

    def round(self, aims: Sequence[str]) -> None:
        """A fresh run, killed at each aim in turn, each time begun again; then compared. An aim is a stage's name, "matching" or "mp4"."""
        run = self.folder / f"round_{self.runs}"
        self.runs += 1
        for aim in aims:
            kill = Kill(len(self.kills), aim, "", 0.0)
            stage = {"matching": "poses", "mp4": "turntable"}.get(aim, aim)
            late = at_share(stage, 3.0, max(self.seconds[stage], 1.0))
            if aim == "matching":
                moment: Callable[[Child], bool] = lambda child, late=late: while_matching(child) or late(child)  # type: ignore[misc]  # noqa: E731
            elif aim == "mp4":
                encoding = while_encoding(run)
                moment = lambda child, late=late, encoding=encoding: encoding(child) or late(child)  # type: ignore[misc]  # noqa: E731
            else:
                moment = at_share(stage, self.random.uniform(0.0, 0.6), self.seconds[stage])
            if kill_when(self.arguments(run), moment, kill, run):
                self.note(kill)
        self.end(run, f"round with kills at {', '.join(aims)}")

    def swap(self, stage: str, after: str) -> None:
        """Alter an artifact of a finished run, so that it is made again and has to take the place of the older one; die on the way."""
        run = self.folder / "swap"
        if not run.exists():
            shutil.copytree(self.folder / "undisturbed", run, symlinks=True)
        output = next(path for path in sorted((run / stage).iterdir()) if path.is_file() and path.name != "manifest.json")
        with output.open("ab") as file:
            file.write(b" ")
        kill = Kill(len(self.kills), f"swap, {after}", stage, 0.0)
        begun = time.monotonic()
        child, thread = start(self.arguments(run), ("-c", SELF_KILLER, stage, after))
        code = finish(child, thread)
        kill.after = time.monotonic() - begun
        old, there = (run / ".work" / f"old-{stage}").exists(), (run / stage).exists()
        kill.hit = f"older artifact {'aside' if old else 'gone'}, new one {'in place' if there else 'not in place'}"
        if code != -signal.SIGKILL:
            raise SystemExit(f"the run was to die in the swap of {stage} and ended with {code}: {child.errors.strip()}")
        self.note(kill)
        self.end(run, f"swap of {stage}, {after}", keep=True)

    def note(self, kill: Kill) -> None:
        self.kills.append(kill)
        where = f"{kill.stage:<14} {kill.hit:<58}"
        print(f"{len(self.kills):>3}  {kill.aim:<14} {where} {kill.after:6.1f} s{'  (had resumed)' if kill.resumed else ''}", flush=True)

    def end(self, run: Path, what: str, *, keep: bool = False) -> None:
        """Run to the end and compare."""
        complete(self.arguments(run))
        found = digests(run)
        wrong = [stage for stage in STAGES if found[stage] != self.expected[stage]]
        left = sorted(path.name for path in (run / ".work").iterdir()) if (run / ".work").is_dir() else []
        if wrong or left:
            self.bad.append({"what": what, "stages": wrong, "left": left})
            print(f"     DIFFERS: {what}: {', '.join(wrong)} {left}", flush=True)
        else:
            print("     the same artifacts as undisturbed", flush=True)
        if not keep and not wrong:
            shutil.rmtree(run)


def source_of(images: int, folder: Path) -> Path:
    """A folder with every n-th of the sample photographs."""
    photographs = sorted(PHOTOGRAPHS.glob("*.jpg"))
    source = folder / "photographs"
    source.mkdir()
    for path in photographs[: min(images, len(photographs))]:
        shutil.copy2(path, source)
    return source


def torment(torture: Torture, kills: int, swaps: Sequence[tuple[str, str]]) -> None:
    """At least `kills`: the swaps, matching and the video twice each, and the rest spread over the stages, two each at least."""
    for stage, after in swaps:
        torture.swap(stage, after)
    wanted = {"matching": "poses", "mp4": "turntable"}
    while True:
        room = kills - len(torture.kills)
        hits = Counter(kill.stage for kill in torture.kills)
        special = [aim for aim in wanted if sum(kill.aim == aim and kill.stage == wanted[aim] for kill in torture.kills) < min(2, kills // 10 + 1)]
        if room <= 0 and not special:
            return
        plan: list[str] = []
        for stage in STAGES:
            # The plain moments first: after a kill in its last part, little of a stage is left to be hit.
            plan += [stage] * max(0 if room <= 0 else 1, 2 - hits[stage])
            plan += [aim for aim in special if wanted[aim] == stage]
        torture.round(plan if room <= 0 or special else plan[: max(room, 1)])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--images", type=int, default=12, help="how many of the sample photographs")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--json", type=Path, default=HERE / "results" / "torture.json", help="where the result goes")
    parser.add_argument("--folder", type=Path, help="where the runs go; default: a temporary folder, removed afterwards")
    given = parser.parse_args()
    swaps = [(stage, after) for stage in ("poses", "train", "turntable") for after in ("aside", "placed")] + [("bake", "before")]
    with contextlib.ExitStack() as stack:
        folder = given.folder or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="torture-")))
        folder.mkdir(parents=True, exist_ok=True)
        torture = Torture(folder, source_of(given.images, folder), OPTIONS, given.seed)
        begun = time.monotonic()
        torture.undisturbed()
        seconds = ", ".join(f"{stage} {took:.1f} s" for stage, took in torture.seconds.items())
        print(f"undisturbed: {torture.total:.1f} s ({seconds})\n", flush=True)
        torment(torture, given.kills, swaps[: max(1, given.kills // 4)])
        hits = Counter(kill.stage for kill in torture.kills)
        result = {
            "kills": len(torture.kills),
            "per_stage": dict(hits),
            "runs_that_differ": torture.bad,
            "undisturbed_seconds": {"total": round(torture.total, 1), **{stage: round(took, 2) for stage, took in torture.seconds.items()}},
            "elapsed_seconds": round(time.monotonic() - begun, 1),
            "machine": {"cores": os.cpu_count(), "platform": platform.platform(), "python": platform.python_version()},
            "moments": [asdict(kill) for kill in torture.kills],
        }
    given.json.parent.mkdir(parents=True, exist_ok=True)
    given.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(f"\n{len(torture.kills)} kills ({', '.join(f'{stage} {hits[stage]}' for stage in STAGES)}); {len(torture.bad)} runs differ; {given.json}")
    return 1 if torture.bad else 0


if __name__ == "__main__":
    sys.exit(main())
