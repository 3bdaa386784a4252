"""Speed of rendering assets on the CPU: written to benchmarks/results/render_cpu.json.

    python benchmarks/render.py ASSET... [--sizes 800x800 640x480] [--threads 1 2] [--frames 24] [--normals] [--rounds 3]
        [--against CHECKOUT] [--json FILE]

Cameras are spread evenly on the asset's orbit. Each asset, size and number of threads is rendered in a process of its own, once in each round; with
`--against` by the code of another checkout too, in turn.
"""

from __future__ import annotations

import argparse
import datetime
import functools
import itertools
import json
import os
import platform
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

from machine import processor

HERE = Path(__file__).resolve().parent


def _seconds(what: Any) -> float:
    begin = time.perf_counter()
    what()
    return time.perf_counter() - begin


def measure(tree: Any, views: list[Any], supersample: int, normals: bool) -> dict[str, float]:
    """Times of each render, after one that compiles and packs; `processor_ms` is the time of all cores together for one."""
    from efficientnerf.asset import rendering

    render = functools.partial(rendering.render, tree, supersample=supersample, normals=normals)
    first = _seconds(lambda: render(views[-1]))
    spent = time.process_time()
    took = [_seconds(lambda view=view: render(view)) for view in views]
    again = [_seconds(lambda view=view: render(view)) for view in views]
    spent = time.process_time() - spent
    best = [min(pair) for pair in zip(took, again, strict=True)]
    rays = views[0].width * views[0].height * supersample**2
    mean = sum(best) / len(best)
    return {
        "first_render_s": round(first, 3),
        "mean_ms": round(mean * 1e3, 2),
        "slowest_ms": round(max(best) * 1e3, 2),
        "all_passes_mean_ms": round((sum(took) + sum(again)) / (2 * len(views)) * 1e3, 2),
        "processor_ms": round(spent / (2 * len(views)) * 1e3, 2),
        "frames_per_s": round(1 / mean, 2),
        "rays_per_s": round(rays / mean),
    }


def measure_task(task: dict[str, Any]) -> dict[str, Any]:
    """One asset, size and number of threads, by the code of a checkout: run in a process of its own."""
    os.environ["NUMBA_NUM_THREADS"] = str(task["threads"])
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    sys.path.insert(0, task["checkout"])

    from efficientnerf.asset import format
    from efficientnerf.asset.camera_paths import turntable_cameras

    asset = Path(task["asset"])
    tree = format.load(asset)
    views = list(turntable_cameras(tree, frames=task["frames"], width=task["width"], height=task["height"], fov=task["fov"]))
    about = {"name": "/".join(asset.parts[-3:]), "bytes": asset.stat().st_size, "voxels": len(tree.density_values)}
    return {"asset": about, "speed": measure(tree, views, task["supersample"], task["normals"])}


def _in_process(task: dict[str, Any]) -> dict[str, Any]:
    """`measure_task` in a process of its own."""
    command = [sys.executable, str(HERE / "render.py"), "--task", json.dumps(task)]
    environment = os.environ | {"PYTHONPATH": task["checkout"]}
    output = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, encoding="utf-8").stdout
    answer: dict[str, Any] = json.loads(output.splitlines()[-1])
    return answer


def _mean(rounds: list[dict[str, Any]]) -> dict[str, float]:
    """The mean of what was measured in each round."""
    return {name: round(sum(each["speed"][name] for each in rounds) / len(rounds), 3) for name in rounds[0]["speed"]}


def compare(task: dict[str, Any], other: Path | None, rounds: int) -> dict[str, Any]:
    """A row of the results: the rounds' means of this checkout, and of another in turn with it."""
    before = os.getloadavg()
    mine, others = [], []
    for _ in range(rounds):
        mine.append(_in_process(task | {"checkout": str(HERE.parent)}))
        if other is not None:
            others.append(_in_process(task | {"checkout": str(other.resolve())}))
    row = task | {"asset": mine[0]["asset"], "speed": _mean(mine)}
    if others:
        row["before"] = _mean(others)
        row["times_as_fast"] = round(row["before"]["mean_ms"] / row["speed"]["mean_ms"], 2)
    return row | {"load": {"before": before, "after": os.getloadavg()}}


def _size(text: str) -> tuple[int, int]:
    width, height = (int(side) for side in text.split("x"))
    return width, height


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("assets", type=Path, nargs="*")
    parser.add_argument("--sizes", type=_size, nargs="+", default=[(800, 800)], metavar="WxH")
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--fov", type=float, default=39.6, help="vertical, degrees; by default that of the Realistic Synthetic scenes")
    parser.add_argument("--supersample", type=int, default=1)
    parser.add_argument("--normals", action="store_true", help="render normals too, which videos do without")
    parser.add_argument("--threads", type=int, nargs="+", default=[os.cpu_count() or 1], help="of numba; all cores by default")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--against", type=Path, help="another checkout of this project, to be measured in turn with this one")
    parser.add_argument("--json", type=Path, default=HERE / "results" / "render_cpu.json")
    parser.add_argument("--task", type=json.loads, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.task:
        print(json.dumps(measure_task(given.task)))
        return
    if not given.assets:
        parser.error("no assets are given")
    rows = []
    for asset, (width, height), threads in itertools.product(given.assets, given.sizes, given.threads):
        task = {"asset": str(asset.resolve()), "width": width, "height": height, "threads": threads}
        row = compare(task | {name: getattr(given, name) for name in ("frames", "fov", "supersample", "normals")}, given.against, given.rounds)
        rows.append(row)
        ratio = f", {row['times_as_fast']} times as fast as before" if given.against else ""
        print(f"{row['asset']['name']} {width}x{height}, {threads} threads: {row['speed']['frames_per_s']} frames a second{ratio}", flush=True)
    result = {
        "date": datetime.date.today().isoformat(),
        "renders": rows,
        "machine": {"processor": processor(), "cores": os.cpu_count(), "platform": platform.platform()},
        "versions": {name: version(name) for name in ("numba", "numpy", "llvmlite")} | {"python": platform.python_version()},
    }
    given.json.parent.mkdir(parents=True, exist_ok=True)
    given.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(f"written to {given.json}")


if __name__ == "__main__":
    main()
