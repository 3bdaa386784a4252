"""How far more cores help: each stage of a run on one core and on two, in turn; serial seconds, and what 4 to 64 cores would make of the rest.

    python -m benchmarks.scaling RUN [--stages train bake ...] [--set STAGE.NAME=VALUE ...] [--repeats N] [--out FILE]

RUN is a finished run; its stages run again in copies of it, on so many cores (affinity and threads), with kernels compiled. Every 5 ms a thread notes which
function of the project the main thread is in. Of a function that takes t1 seconds on one core and t2 on two,

    serial = 2 t2 - t1                      Amdahl
    t(n)   = serial + (t1 - serial) / n     the bandwidth of the memory limits less (docs/experiments/first-minutes.md)
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

from benchmarks.machine import processor
from benchmarks.project import PACKAGES, ROOT
from pipeline.executors.cores import VARIABLES

OURS = tuple(str(ROOT / name) + os.sep for name in PACKAGES)
INTERVAL = 0.005  # seconds between two samples
CORES = (4, 8, 16, 64)
STAGES = ("poses", "train", "bake", "mesh", "splats", "evaluate", "turntable", "points")
SHOWN = 12  # functions of a stage


def serial_seconds(one: float, two: float) -> float:
    """The part that does not become faster, of what takes `one` second on one core and `two` on two."""
    return min(max(2 * two - one, 0.0), one)


def predicted(one: float, two: float, cores: int) -> float:
    """Seconds on so many cores of what takes `one` on one and `two` on two."""
    serial = serial_seconds(one, two)
    return serial + (one - serial) / cores


class Watch:
    """Seconds of the main thread by the innermost function of the project, sampled."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()
        self._main = threading.main_thread().ident
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._sample, daemon=True)

    def __enter__(self) -> Watch:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _sample(self) -> None:
        last = time.perf_counter()
        while not self._ended.wait(INTERVAL):
            name = _innermost(sys._current_frames().get(self._main or 0))
            now = time.perf_counter()
            self.seconds[name] += now - last
            last = now


def _innermost(frame: FrameType | None) -> str:
    while frame is not None:
        path = frame.f_code.co_filename
        if path.startswith(OURS):
            return f"{Path(path).relative_to(ROOT).with_suffix('').as_posix()} {frame.f_code.co_qualname}"
        frame = frame.f_back
    return "libraries"


def measure_stage(run_folder: Path, stage: str, sets: list[str], cores: int) -> dict[str, float]:
    """Seconds by function of a stage that runs again, in this process; "" is all of it."""
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
    from pipeline.executors.local import execute_alone
    from pipeline.runner import run_stages
    from workflows.asset import WORKFLOW
    from workflows.cli.request import Options, plan_run

    plan = plan_run(run_folder, WORKFLOW, Options(sets=tuple(sets)))
    with plan.written() as run, Watch() as watch:
        start = time.perf_counter()
        run_stages(run, WORKFLOW.stages, only=stage, force=True, device="cpu", execute=execute_alone)
        seconds = time.perf_counter() - start
    return {"": seconds, **watch.seconds}


def measured_apart(run: Path, stage: str, sets: list[str], cores: int) -> dict[str, float]:
    """What `measure_stage` finds in a copy of the run, by a process on so many cores."""
    environment = {**os.environ, **dict.fromkeys(VARIABLES, str(cores)), "ENERF_PRECOMPILE": "off"}
    with tempfile.TemporaryDirectory(dir=run.parent) as folder:
        copy = Path(folder) / "run"
        shutil.copytree(run, copy)
        options = [word for text in sets if text.startswith(f"{stage}.") for word in ("--set", text)]
        command = [sys.executable, "-m", "benchmarks.scaling", str(copy), "--stages", stage, *options, "--cores", str(cores)]
        done = subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, check=True)
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def measure(run: Path, stages: list[str], sets: list[str], repeats: int) -> dict[str, Any]:
    """Of each stage and function the median seconds on one core and on two."""
    found: dict[str, Any] = {"processor": processor(), "sets": sets, "stages": {}}
    for stage in stages:
        times: dict[int, list[dict[str, float]]] = {1: [], 2: []}
        for _ in range(repeats):
            for cores in (2, 1):
                times[cores].append(measured_apart(run, stage, sets, cores))
        names = {name for each in times[1] + times[2] for name in each}
        medians = {name: [statistics.median(each.get(name, 0.0) for each in times[cores]) for cores in (1, 2)] for name in names}
        found["stages"][stage] = dict(sorted(medians.items(), key=lambda item: -serial_seconds(*item[1])))
        print(f"{stage}: {medians[''][0]:.1f} s on one core, {medians[''][1]:.1f} on two", file=sys.stderr)
    return found


def as_markdown(found: dict[str, Any]) -> str:
    """Tables: the stages, and of each the functions with most serial seconds."""
    rows = {stage: times[""] for stage, times in found["stages"].items()}
    ahead = {stage: _ahead(times) for stage, times in rows.items()}
    whole = [sum(times[index] for times in rows.values()) for index in (0, 1)]
    lines = [found["processor"], "", *_head("stage"), *(_row(stage, times, ahead[stage]) for stage, times in rows.items())]
    lines.append(_row("all", whole, [sum(column) for column in zip(*ahead.values(), strict=True)]))
    for stage, times in found["stages"].items():
        functions = [_row(name, each, _ahead(each)) for name, each in times.items() if name]
        lines += ["", *_head(f"{stage}, by function"), *functions[:SHOWN]]
    return "\n".join(lines) + "\n"


def _head(first: str) -> list[str]:
    columns = (first, "1 core, s", "2 cores, s", "serial s", "serial", *(f"{cores} cores" for cores in CORES))
    return [f"| {' | '.join(columns)} |", "|---|" + "--:|" * (4 + len(CORES))]


def _ahead(times: list[float]) -> list[float]:
    return [predicted(*times, cores) for cores in CORES]


def _row(name: str, times: list[float], ahead: list[float]) -> str:
    serial = serial_seconds(*times)
    seconds = " | ".join(f"{each:.1f}" for each in ahead)
    return f"| {name} | {times[0]:.1f} | {times[1]:.1f} | {serial:.1f} | {serial / max(times[0], 1e-9):.0%} | {seconds} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--stages", nargs="+", default=list(STAGES), choices=STAGES)
    parser.add_argument("--set", dest="sets", action="append", default=[])
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--cores", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.cores:
        print(json.dumps(measure_stage(given.run, given.stages[0], given.sets, given.cores)))
    else:
        found = measure(given.run.absolute(), given.stages, given.sets, given.repeats)
        print(as_markdown(found))
        if given.out is not None:
            given.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
