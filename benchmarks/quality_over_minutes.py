"""Quality over minutes on a CPU: each scene trained for 1, 5, 10 and 30 minutes, its asset as written measured on all pixels of all test views.

    python -m benchmarks.quality_over_minutes --runs FOLDER [--sets chair_800,fern_4,still_life,object,court,window,gloss] [--minutes 1,5,10,30]
                                              [--options="--set bake.max_mib=40"] [--out benchmarks/results] [--readme docs/results.md]

Each row is a run of its own, from the source, with `enerf run --budget`. Cameras found from photographs are found once and copied: they are no part of the
minutes. A row is written as soon as it is measured; with the same code and options it is not measured again, and one that was broken off begins anew.
Writes quality_over_minutes.json, and a table and a plot of it with the rows of peers (`benchmarks.peers`); --readme replaces what stands between
the marks in a document. Made scenes are written to FOLDER/scenes where they are not there: `python -m benchmarks.scenes`.
"""

import argparse
import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from benchmarks.machine import busy_seconds, processor
from benchmarks.minutes import OURS, read_rows, same_row, show, with_row, write_rows
from benchmarks.project import DATA, ENERF, RESULTS, ROOT, code_version
from pipeline.files import read_json
from stages.artifacts import BakeOutputs, EvaluateOutputs

SETS = ("chair_800", "fern_4", "still_life", "object", "court", "window", "gloss")
MADE = {"object": (), "court": (), "window": ("--as", "llff"), "gloss": ()}  # kinds of made scenes, and how they are read
MADE_VIEWS = {"size": 400, "train": 60, "val": 10, "test": 20}
FILE = "quality_over_minutes"
PEERS = "peers.json"
# The asset is what counts, not the network.
EVALUATION = (
    "evaluate.field_views=1", "evaluate.strips=off", "evaluate.captured_path_frames=off", "mesh.texture=off",
    "splats.make=off",
)  # fmt: skip
LIBRARIES = ("torch", "numba", "numpy")


def source_of(name: str, data: Path, scenes: Path) -> tuple[Path, tuple[str, ...]]:
    """The folder of a set and more options to read it with; made scenes are made. Raises SystemExit where there is none."""
    if name in MADE:
        if not (scenes / name / "transforms.json").exists():
            views = [f"--{key}={value}" for key, value in MADE_VIEWS.items()]
            subprocess.run([sys.executable, "-m", "benchmarks.scenes", str(scenes), "--kinds", name, *views], check=True, cwd=ROOT)
        return scenes / name, MADE[name]
    folder = ROOT / "examples" / name if name == "still_life" else data / name
    if not folder.is_dir():
        raise SystemExit(f"{name}: no folder {folder}. Made scenes: {', '.join(MADE)}.")
    return folder, ()


def cameras_of(name: str, source: Path, read: Sequence[str], runs: Path) -> Path:
    """A run of the poses stage alone: made once."""
    run = runs / f"{name}-poses"
    subprocess.run([*ENERF, "run", str(source), "--out", str(run), "--until", "poses", "--quiet", *read], check=True)
    return run


def cost_of(command: Sequence[str]) -> tuple[float, float]:
    """Run a command: its seconds by the clock, and the processor seconds of all its threads and children."""
    start = time.perf_counter()
    child = subprocess.Popen(command)
    _, status, used = os.wait4(child.pid, 0)
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode != 0:
        raise SystemExit(f"{shlex.join(command)}: exit code {child.returncode}")
    return time.perf_counter() - start, used.ru_utime + used.ru_stime


def row_of(name: str, poses: Path, run: Path, minutes: float, options: Sequence[str]) -> dict[str, Any]:
    """Copy the run of the cameras, train for so long, bake, evaluate, and read the figures."""
    shutil.rmtree(run, ignore_errors=True)
    shutil.copytree(poses, run, ignore=shutil.ignore_patterns(".lock"))
    load, busy = os.getloadavg(), busy_seconds()
    seconds, cpu_seconds = cost_of([*ENERF, "run", "--out", str(run), "--budget", f"{60 * minutes:g}s", "--until", "bake", "--quiet", *options])
    now = busy_seconds()
    others = None if busy is None or now is None else round((now - busy - cpu_seconds) / seconds, 2)
    settings = [word for each in EVALUATION for word in ("--set", each)]
    subprocess.run([*ENERF, "run", "--out", str(run), "--until", "evaluate", "--quiet", *settings], check=True)
    status = json.loads(subprocess.run([*ENERF, "status", str(run), "--json"], stdout=subprocess.PIPE, check=True).stdout)
    stages = {stage["name"]: stage for stage in status["stages"] if stage["seconds"] is not None and stage["name"] in ("train", "bake", "evaluate")}
    metrics = read_json(EvaluateOutputs.of_run(run).metrics)
    return {
        "method": OURS, "set": name, "minutes": minutes, "options": shlex.join(options),
        "psnr": metrics["asset"]["psnr"], "ssim": metrics["asset"]["ssim"], "views": metrics["asset"]["views"], "stride": 1,
        "megabytes": BakeOutputs.of_run(run).asset.stat().st_size / 1e6,
        "peak_mib": max(stage["peak_memory"] for key, stage in stages.items() if key != "evaluate") / 2**20,
        "seconds": stages["train"]["seconds"] + stages["bake"]["seconds"], "stage_seconds": {key: stage["seconds"] for key, stage in stages.items()},
        "cpu_seconds": cpu_seconds, "load": load, "others": others, "processor": processor(),
        "versions": {library: version(library) for library in LIBRARIES},
    }  # fmt: skip


def measure(sets: Sequence[str], minutes: Sequence[float], given: argparse.Namespace) -> None:
    """Every row that is not there with this code, the short ones of all sets first."""
    path, code, options = given.out / f"{FILE}.json", code_version(), shlex.split(given.options)
    sources = {name: source_of(name, given.data, given.runs / "scenes") for name in sets}
    for budget in sorted(minutes):
        for name, (source, read) in sources.items():
            named: Mapping[str, Any] = {"method": OURS, "set": name, "minutes": budget, "options": shlex.join(options)}
            if any(same_row(row, named) and row["code"] == code for row in read_rows(path)):
                print(f"{name}, {budget:g} min: measured before", flush=True)
                continue
            poses = cameras_of(name, source, read, given.runs)
            row = row_of(name, poses, given.runs / f"{name}-{budget:g}m", budget, options) | {"code": code}
            write_rows(path, with_row(read_rows(path), row))
            print(f"{name}, {budget:g} min: {row['psnr']:.2f} dB, {row['megabytes']:.1f} MB, {row['seconds']:.0f} s", flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, required=True, help="folder of the runs")
    parser.add_argument("--sets", default=",".join(SETS), help=f"names, with commas between; also those of {DATA}")
    parser.add_argument("--minutes", default="1,5,10,30")
    parser.add_argument("--options", default="", help="more options of `enerf run`, in one text; rows of other options stay")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the sets that are neither made nor examples")
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--readme", type=Path, help="a document with marks, between which the table is put")
    given = parser.parse_args(arguments)
    given.runs.mkdir(parents=True, exist_ok=True)
    measure([name for name in given.sets.split(",") if name], [float(word) for word in given.minutes.split(",") if word], given)
    show([given.out / f"{FILE}.json", given.out / PEERS], FILE, given.out, given.readme)


if __name__ == "__main__":
    main()
