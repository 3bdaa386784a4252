"""How far more cores help: each stage of a run on one core and on two, in turn; serial seconds, and what 4 to 64 cores would make of the rest.

    python -m benchmarks.scaling RUN [--stages train bake ...] [--set STAGE.NAME=VALUE ...] [--repeats N] [--bandwidth CORES=GB/S,...] [--out FILE]

RUN is a finished run; its stages run again in copies of it, on so many cores (affinity and threads), with kernels compiled. A thread looks every 5 ms which
function of the project the main thread is in. Of a function that takes t1 seconds on one core and t2 on two,

    serial = 2 t2 - t1                                                     Amdahl
    t(n)   = serial + max((t1 - serial) / n, bytes / bandwidth(n))

bytes         that a stage's kernels move, counted in one more run: the sizes of the arrays that each call of a kernel is given, read or written, those below
              a MiB left out, which stay in caches; at most what one core can have moved in t1 - serial. An estimate: of a hash table a call may touch a part
bandwidth(n)  n times STREAM's triad on one core, at most that of a machine of n cores: --bandwidth, or what is typical (BANDWIDTH), an assumption
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
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from benchmarks.machine import processor
from benchmarks.project import PACKAGES, ROOT
from pipeline.executors.cores import VARIABLES

OURS = tuple(str(ROOT / name) + os.sep for name in PACKAGES)
INTERVAL = 0.005  # seconds between two looks
CORES = (4, 8, 16, 64)
# STREAM's triad on all of a machine's cores, bytes a second: two channels of DDR4-3200 (laptop) and of DDR5-5600 (desktop), eight of DDR4-3200 (server)
BANDWIDTH = {4: 35e9, 8: 60e9, 16: 60e9, 64: 150e9}
CACHED = 2**20  # bytes of an array below which it stays in caches
STAGES = ("poses", "train", "bake", "mesh", "splats", "evaluate", "turntable", "points")
SHOWN = 12  # functions of a stage


def serial_seconds(one: float, two: float) -> float:
    """The part that does not become faster, of what takes `one` second on one core and `two` on two."""
    return min(max(2 * two - one, 0.0), one)


def bandwidth(cores: int, one: float, machine: dict[int, float]) -> float:
    """Bytes a second on so many cores, with `one` on one core: that many times as much, up to what a machine of so many cores has."""
    return min(cores * one, machine[cores]) if cores in machine else cores * one


def predicted(one: float, two: float, cores: int, moved: float = 0.0, speed: float = 1.0) -> float:
    """Seconds on so many cores of what takes `one` on one and `two` on two, and moves so many bytes, `speed` a second on these cores."""
    serial = serial_seconds(one, two)
    return serial + max((one - serial) / cores, moved / speed)


class Bytes:
    """Counts the sizes of the arrays of CACHED bytes and more that kernels are called with; one that a call is given twice, once."""

    def __init__(self) -> None:
        self.moved = 0

    def __enter__(self) -> Bytes:
        from efficientnerf.backends.numba.runtime import numba

        self._kernel: Any = numba.core.registry.CPUDispatcher
        call, count = self._kernel.__call__, self.add

        def counted(kernel: Any, *arguments: Any, **named: Any) -> Any:
            count((*arguments, *named.values()))
            return call(kernel, *arguments, **named)

        self._kernel.__call__ = counted
        return self

    def __exit__(self, *_: object) -> None:
        del self._kernel.__call__

    def add(self, arguments: tuple[Any, ...]) -> None:
        sizes: dict[int, int] = {}
        for array in _arrays(arguments):
            sizes[array.ctypes.data] = max(array.nbytes, sizes.get(array.ctypes.data, 0))
        self.moved += sum(size for size in sizes.values() if size >= CACHED)


def _arrays(values: Iterable[Any]) -> Iterator[np.ndarray]:
    """Those among arguments, and in tuples of them."""
    for value in values:
        if isinstance(value, np.ndarray):
            yield value
        elif isinstance(value, tuple):
            yield from _arrays(value)


class Watch:
    """Seconds of the main thread by the innermost function of the project, sampled."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()
        self._main = threading.main_thread().ident
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)

    def __enter__(self) -> Watch:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _look(self) -> None:
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


def measure_stage(run_folder: Path, stage: str, sets: list[str], cores: int, *, count: bool = False) -> dict[str, float]:
    """Seconds by function of a stage that runs again, in this process; "" is all of it. With `count` the bytes that its kernels move, alone."""
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
    from pipeline.executors.local import execute_alone
    from pipeline.runner import run_stages
    from workflows.asset import WORKFLOW
    from workflows.cli.request import Options, plan_run

    plan = plan_run(run_folder, WORKFLOW, Options(sets=tuple(sets)))
    with plan.written() as run, Bytes() if count else Watch() as watch:
        start = time.perf_counter()
        run_stages(run, WORKFLOW.stages, only=stage, force=True, device="cpu", execute=execute_alone)
        seconds = time.perf_counter() - start
    return {"bytes": watch.moved} if isinstance(watch, Bytes) else {"": seconds, **watch.seconds}


def triad(cores: int) -> float:
    """Bytes a second of STREAM's triad, a = b + s c, on so many cores: the best of several."""
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])
    import torch

    torch.set_num_threads(cores)
    a, b, c = (torch.ones(1 << 25) for _ in range(3))
    best = 0.0
    for _ in range(8):
        start = time.perf_counter()
        torch.add(b, c, alpha=3.0, out=a)
        best = max(best, 3 * 4 * a.numel() / (time.perf_counter() - start))
    return best


def _apart(arguments: list[str], cores: int) -> Any:
    """What this program answers in a process on so many cores."""
    environment = {**os.environ, **dict.fromkeys(VARIABLES, str(cores)), "ENERF_PRECOMPILE": "off"}
    command = [sys.executable, "-m", "benchmarks.scaling", *arguments, "--cores", str(cores)]
    done = subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def _again(run: Path, stage: str, sets: list[str], cores: int, *more: str) -> Any:
    """What `measure_stage` finds in a copy of the run."""
    with tempfile.TemporaryDirectory(dir=run.parent) as folder:
        copy = Path(folder) / "run"
        shutil.copytree(run, copy)
        arguments = [str(copy), "--stages", stage, *(word for text in sets if text.startswith(f"{stage}.") for word in ("--set", text))]
        return _apart([*arguments, *more], cores)


def measure(run: Path, stages: list[str], sets: list[str], repeats: int) -> dict[str, Any]:
    """Of each stage and function the median seconds on one core and on two."""
    found: dict[str, Any] = {"processor": processor(), "triad": [_apart(["--triad"], cores) for cores in (1, 2)], "sets": sets, "stages": {}, "bytes": {}}
    for stage in stages:
        times: dict[int, list[dict[str, float]]] = {1: [], 2: []}
        for _ in range(repeats):
            for cores in (2, 1):
                times[cores].append(_again(run, stage, sets, cores))
        found["bytes"][stage] = _again(run, stage, sets, 2, "--count")["bytes"]
        names = {name for each in times[1] + times[2] for name in each}
        medians = {name: [statistics.median(each.get(name, 0.0) for each in times[cores]) for cores in (1, 2)] for name in names}
        found["stages"][stage] = dict(sorted(medians.items(), key=lambda item: -serial_seconds(*item[1])))
        print(f"{stage}: {medians[''][0]:.1f} s on one core, {medians[''][1]:.1f} on two", file=sys.stderr)
    return found


def as_markdown(found: dict[str, Any], machine: dict[int, float] = BANDWIDTH) -> str:
    """Tables: the stages, and of each the functions with most serial seconds.

    machine  bytes a second on all cores of machines with so many
    """
    one, two = found["triad"]
    speed = {cores: bandwidth(cores, one, machine) for cores in CORES}
    lines = [f"{found['processor']}; STREAM triad {one / 1e9:.1f} GB/s on one core, {two / 1e9:.1f} on two", ""]
    lines += ["assumed " + ", ".join(f"{speed[cores] / 1e9:.0f} GB/s on {cores}" for cores in CORES), ""]
    head = "| serial s | serial | GB moved | " + " | ".join(f"{cores} cores" for cores in CORES) + " |"
    lines += [f"| stage | 1 core, s | 2 cores, s {head}", "|---|" + "--:|" * (5 + len(CORES))]
    rows, counted = {stage: times[""] for stage, times in found["stages"].items()}, found.get("bytes", {})
    moved = {stage: min(counted.get(stage, 0.0), (times[0] - serial_seconds(*times)) * one) for stage, times in rows.items()}
    ahead = {stage: [predicted(*times, cores, moved[stage], speed[cores]) for cores in CORES] for stage, times in rows.items()}
    lines += [_row(stage, times, ahead[stage], moved[stage]) for stage, times in rows.items()]
    whole = [sum(times[index] for times in rows.values()) for index in (0, 1)]
    lines.append(_row("all", whole, [sum(column) for column in zip(*ahead.values(), strict=True)], sum(moved.values())))
    for stage, times in found["stages"].items():
        lines += ["", f"| {stage}, by function, bytes left out | 1 core, s | 2 cores, s {head}", "|---|" + "--:|" * (5 + len(CORES))]
        lines += [_row(name, each, [predicted(*each, cores) for cores in CORES]) for name, each in list(times.items()) if name][:SHOWN]
    return "\n".join(lines) + "\n"


def _row(name: str, times: list[float], ahead: list[float], moved: float | None = None) -> str:
    serial = serial_seconds(*times)
    size = "" if moved is None else f"{moved / 1e9:.0f}"
    seconds = " | ".join(f"{each:.1f}" for each in ahead)
    return f"| {name} | {times[0]:.1f} | {times[1]:.1f} | {serial:.1f} | {serial / max(times[0], 1e-9):.0%} | {size} | {seconds} |"


def _bandwidths(text: str) -> dict[int, float]:
    """Of "8=60,16=80", GB/s, with BANDWIDTH for other numbers of cores."""
    return BANDWIDTH | {int(cores): float(speed) * 1e9 for cores, speed in (part.split("=") for part in text.split(","))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, nargs="?")
    parser.add_argument("--stages", nargs="+", default=list(STAGES), choices=STAGES)
    parser.add_argument("--set", dest="sets", action="append", default=[])
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--bandwidth", type=_bandwidths, default=BANDWIDTH, help="GB/s on all cores of a machine with so many: 8=60,16=80")
    parser.add_argument("--count", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--cores", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--triad", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.triad:
        print(json.dumps(triad(given.cores)))
    elif given.cores:
        print(json.dumps(measure_stage(given.run, given.stages[0], given.sets, given.cores, count=given.count)))
    else:
        found = measure(given.run.absolute(), given.stages, given.sets, given.repeats)
        print(as_markdown(found, given.bandwidth))
        if given.out is not None:
            given.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
