"""Rays per second of a step of tree training on the CPU, by its parts, beside what the machine's cache lines allow.

    python benchmarks/tree_training.py RUN [--json FILE] [--seconds 4] [--threads 1,2] [--rays 32768] [--patch-side 4]

RUN is a folder in which `bake` is done, of an object with alpha or a forward-facing scene. Steps are those of the refinement, from the baked asset, on all
tiles of the images that its rays may meet. Each figure is the least of several steps. Busy: processor time over elapsed time and threads.

The floor counts cache lines. Forward and backward must read density and harmonics of each voxel that a packet meets, and write, sort and read
its record; a step must read and write the harmonics and four more numbers of each voxel, once. `line_rate` is how many lines of a table as large as
the harmonics are read a second in random order. Each number of threads is measured in a process of its own.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from machine import processor

ROOT = Path(__file__).resolve().parents[1]
LINE, RECORD, RECORDED = 64, 24, 3  # bytes; times that a record is moved: written, put in order, read


def timed(seconds: dict[str, list[tuple[float, float]]], name: str, work: Callable[..., Any], *arguments: Any) -> Any:
    """What `work` returns of the arguments; elapsed and processor time are added to those of its name."""
    elapsed, spent = time.perf_counter(), time.process_time()
    found = work(*arguments)
    seconds.setdefault(name, []).append((time.perf_counter() - elapsed, time.process_time() - spent))
    return found


def line_rate(bytes_: int, seconds: float) -> float:
    """Cache lines of a table of so many bytes that are read a second in random order, by all threads."""
    import numba
    import numpy as np

    @numba.njit(parallel=True, error_model="numpy")
    def gather(table, place, tasks):  # type: ignore[no-untyped-def]
        total, share = np.zeros(tasks, np.float32), len(place) // tasks
        for task in numba.prange(tasks):
            some = np.float32(0)
            for n in range(task * share, (task + 1) * share):
                some += table[place[n], 0]
            total[task] = some
        return total

    table = np.ones((max(bytes_ // LINE, 1), LINE // 4), np.float32)
    place = np.random.default_rng(0).integers(0, len(table), 2**21)
    gather(table, place, numba.get_num_threads())
    shortest, until = float("inf"), time.perf_counter() + seconds
    while time.perf_counter() < until:
        began = time.perf_counter()
        gather(table, place, numba.get_num_threads())
        shortest = min(shortest, time.perf_counter() - began)
    return len(place) / shortest


def loaded(run: Path) -> tuple[Any, Any]:
    """The baked tree, with plain harmonics, and what it is fitted to."""
    import numpy as np

    from efficientnerf.asset import format
    from efficientnerf.asset.refinement.targets import Targets
    from stages.artifacts import BakeOutputs
    from stages.evaluate.views import constant_background
    from stages.io import scene
    from stages.io.refined_cameras import load_scene
    from stages.train.data import pixels_of

    s = load_scene(run / "poses", run / "train")
    tree = format.load(BakeOutputs(run / "bake").asset)
    tree = replace(tree, harmonics=np.ascontiguousarray(tree.sh, np.float32))
    return tree, Targets(pixels_of(run / "poses", scene.views_of(s, "train")), constant_background(s), tree.environment, tree.ndc is not None)


def measured(run: Path, seconds: float, rays: int, side: int) -> dict[str, Any]:
    """Figures of steps on this process's threads."""
    import numpy as np
    from numba import get_num_threads

    from efficientnerf.asset.refinement.error_map import ErrorMap
    from efficientnerf.asset.refinement.host import in_voxels, packet_bases
    from efficientnerf.asset.refinement.state import MAX_INITIAL_THICKNESS, initial_state
    from efficientnerf.asset.refinement.targets import step_rng
    from efficientnerf.asset.refinement.tiles import tiles_met
    from efficientnerf.backends.layout import Hyperparameters, Moments
    from efficientnerf.backends.numba.tree.cells import cells_of
    from efficientnerf.backends.numba.tree_training import gradients
    from efficientnerf.backends.numba.tree_training.neighbours import neighbours_of
    from efficientnerf.backends.numba.tree_training.steps import step, values_of
    from efficientnerf.training.patches import PatchGrid

    tree, targets = loaded(run)
    state = initial_state(tree, MAX_INITIAL_THICKNESS)
    cells, buffer, patches = cells_of(tree), gradients.RecordBuffer(), PatchGrid(targets.pixels, side)
    values, error_map = values_of(cells, state.density, state.sh), ErrorMap(patches, tiles_met(tree, patches))
    width = state.sh.shape[1]
    moments = Moments(np.zeros(0, np.float32), np.zeros((0, width), np.float32), state.square_density, state.square_sh, state.visits)
    rule = Hyperparameters(0.1, 0.01, 1.0, total_variation=0.01)
    neighbours = neighbours_of(cells)
    times: dict[str, list[tuple[float, float]]] = {}
    counts, number, until = [], 0, time.perf_counter() + seconds

    def drawn() -> Any:
        found = error_map.draw(rays, step_rng(0, number)).patches
        origins, directions, wanted = targets.of(found.pixels)
        start, along, bases = in_voxels(tree, origins, directions)
        return found.first, start, along, packet_bases(bases, found.first), values.dense, values.sh, wanted, buffer

    while number < 4 or time.perf_counter() < until:
        number += 1
        given = timed(times, "rays", drawn)
        loss, records = timed(times, "forward and backward", gradients.forward_backward, cells, *given)
        timed(times, "sums and step", step, records, values, moments, rule, neighbours)
        written = [records.numbers[a:b, 0] for a, b in zip(records.begin[:, 0], records.begin[:, -1], strict=True)]
        counts.append((len(loss), sum(map(len, written)), len(np.unique(np.concatenate(written)))))
    count, recorded, met = (float(np.mean([row[n] for row in counts[1:]])) for n in range(3))
    least = {name: min(elapsed for elapsed, _ in some[1:]) for name, some in times.items()}
    elapsed, spent = (sum(sum(row[n] for row in some[1:]) for some in times.values()) for n in range(2))
    row_lines = -(-4 * width // LINE)
    lines = {
        "forward and backward": recorded * (row_lines + 4 / LINE + RECORDED * RECORD / LINE),
        "sums and step": met * 2 * (row_lines + 16 / LINE),
    }
    rate = line_rate(state.sh.nbytes, min(seconds, 1.0))
    floor = {name: some / rate for name, some in lines.items()}
    return {
        "threads": get_num_threads(), "voxels": len(state.density), "rays": count, "records_per_ray": recorded / count, "voxels_per_ray": met / count,
        "seconds": least, "rays_per_second": count / sum(least.values()), "rays_per_second_forward_backward": count / least["forward and backward"],
        "busy": spent / elapsed / get_num_threads(), "bytes_per_ray": LINE * sum(lines.values()) / count, "line_rate": rate,
        "floor_seconds": floor, "floor_rays_per_second": count / sum(floor.values()),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="with a finished bake")
    parser.add_argument("--json", type=Path, help="where to write the figures")
    parser.add_argument("--seconds", type=float, default=4.0, help="for each number of threads")
    parser.add_argument("--threads", default=f"1,{len(os.sched_getaffinity(0))}", help="numbers of threads, with commas")
    parser.add_argument("--rays", type=int, default=32768, help="of a step")
    parser.add_argument("--patch-side", type=int, default=4, help="pixels along a side of a patch")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        print(json.dumps(measured(arguments.run, arguments.seconds, arguments.rays, arguments.patch_side)))
        return
    load, found = os.getloadavg(), {}
    options = ["--seconds", str(arguments.seconds), "--rays", str(arguments.rays), "--patch-side", str(arguments.patch_side)]
    for threads in dict.fromkeys(arguments.threads.split(",")):
        environment = {**os.environ, "OMP_NUM_THREADS": threads, "NUMBA_NUM_THREADS": threads, "OMP_WAIT_POLICY": "PASSIVE", "PYTHONPATH": str(ROOT)}
        command = [sys.executable, __file__, str(arguments.run), "--child", *options]
        found[threads] = json.loads(subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True).stdout.splitlines()[-1])
    for threads, row in found.items():
        print(f"{threads} threads, {row['voxels']:,} voxels: {row['rays_per_second']:,.0f} rays/s, floor {row['floor_rays_per_second']:,.0f}; cores"
              f" {row['busy']:.0%} busy; {row['bytes_per_ray']:,.0f} bytes, {row['records_per_ray']:.1f} records a ray")  # fmt: skip
        for name, seconds in row["seconds"].items():
            floor = f"floor {1e3 * row['floor_seconds'][name]:6.1f} ms" if name in row["floor_seconds"] else ""
            print(f"  {name:24}{1e3 * seconds:8.1f} ms{row['rays'] / seconds:14,.0f} rays/s   {floor}")
    if arguments.json:
        report = {
            "date": datetime.datetime.now(datetime.UTC).date().isoformat(), "processor": processor(), "cores": len(os.sched_getaffinity(0)),
            "load_before": load, "load_after": os.getloadavg(), "python": platform.python_version(),
            "versions": {name: version(name) for name in ("numba", "numpy")}, "threads": found,
        }  # fmt: skip
        arguments.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
