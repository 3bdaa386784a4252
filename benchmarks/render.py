"""Speed of rendering assets on the CPU, and what bounds it: written to benchmarks/results/render_cpu.json.

    python benchmarks/render.py ASSET... [--sizes 800x800 640x480] [--threads 1 2] [--frames 24] [--normals] [--rounds 3]
        [--against CHECKOUT] [--json FILE]
    python benchmarks/render.py --whole-scene --sizes 640x480

Cameras are spread evenly on the asset's orbit, or inside of the scene that `whole_scene.py` makes, of nested grids. Besides frames a second: samples and
colours of a ray, the bytes that they read, the measured bandwidth of the memory, and the load average. Each asset, size and number of threads is rendered in a
process of its own, once in each round; with `--against` by the code of another checkout too, in turn.
"""

from __future__ import annotations

import argparse
import datetime
import functools
import inspect
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
TRIAD_BYTES = 512 * 2**20  # far more than any cache holds


def bandwidth() -> dict[str, float]:
    """Gigabytes a second that all threads together read and write: a = b + s * c over arrays far larger than the caches."""
    import numba
    import numpy as np

    @numba.njit(parallel=True)
    def triad(a, b, c, s):  # type: ignore[no-untyped-def]
        for i in numba.prange(len(a)):
            a[i] = b[i] + s * c[i]

    @numba.njit(parallel=True, fastmath=True)
    def total(a):  # type: ignore[no-untyped-def]
        out = np.float32(0)
        for i in numba.prange(len(a)):
            out += a[i]
        return out

    a, b, c = (np.full(TRIAD_BYTES // 12, 0.5, np.float32) for _ in range(3))
    triad(a, b, c, np.float32(2))
    total(a)
    copying = min(_seconds(lambda: triad(a, b, c, np.float32(2))) for _ in range(5))
    reading = min(_seconds(lambda: total(a)) for _ in range(5))
    return {"triad_gb_per_s": round(3 * a.nbytes / copying / 1e9, 1), "read_gb_per_s": round(a.nbytes / reading / 1e9, 1)}


def _seconds(what: Any) -> float:
    begin = time.perf_counter()
    what()
    return time.perf_counter() - begin


def cameras(tree: Any, width: int, height: int, count: int, fov: float) -> list[Any]:
    """`count` cameras on the asset's orbit."""
    from efficientnerf.asset.camera_paths import turntable_cameras

    return list(turntable_cameras(tree, frames=count, width=width, height=height, fov=fov))


def measure(tree: Any, views: list[Any], supersample: int, normals: bool) -> dict[str, Any]:
    """Times of each render, after one that compiles and packs; `processor_ms` is the time of all cores together for one."""
    from efficientnerf.asset import rendering

    more = {} if normals else {"normals": False}
    if "normals" not in inspect.signature(rendering.render).parameters:  # of an older checkout, which always renders them
        more = {}
    render = functools.partial(rendering.render, tree, supersample=supersample, **more)
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


def memory(tree: Any, view: Any) -> dict[str, float]:
    """Bytes in memory while rendering: the tree, its packed form, the colours of the view, and the framebuffer."""
    from efficientnerf.asset.rendering import render
    from efficientnerf.backends.numba.tree.packed import packed_of

    values = vars(tree) | vars(tree.harmonics) if hasattr(tree.harmonics, "__dict__") else vars(tree)
    own = sum(part.nbytes for part in values.values() if hasattr(part, "nbytes") and not isinstance(part, tuple))
    rendering = render(tree, view)
    framebuffer = sum(part.nbytes for part in vars(rendering).values())
    colours = 8 * (len(tree.density_values) + 2)
    total = own + packed_of(tree).nbytes + colours + framebuffer
    each = round(total / max(1, len(tree.density_values)), 1)
    packed = packed_of(tree).nbytes
    return {"tree": own, "packed": packed, "view_colours": colours, "framebuffer": framebuffer, "total": total, "bytes_per_voxel": each}


def measure_task(task: dict[str, Any]) -> dict[str, Any]:
    """One asset, size and number of threads, by the code of a checkout: run in a process of its own."""
    os.environ["NUMBA_NUM_THREADS"] = str(task["threads"])
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    sys.path.insert(0, task["checkout"])
    sys.path.append(str(HERE))  # `whole_scene` of this checkout

    import whole_scene

    from efficientnerf.asset import format

    asset = Path(task["asset"]) if task["asset"] else None
    begin = time.perf_counter()
    tree = whole_scene.whole_scene() if asset is None else format.load(asset)
    loading = time.perf_counter() - begin
    size = task["width"], task["height"], task["frames"]
    views = whole_scene.cameras(*size) if asset is None else cameras(tree, *size, task["fov"])
    result: dict[str, Any] = {"speed": measure(tree, views, task["supersample"], task["normals"])}
    if task["whole"]:
        result |= {
            "asset": {
                "name": "made scene" if asset is None else "/".join(asset.parts[-3:]),
                "bytes": 0 if asset is None else asset.stat().st_size,
                "voxels": len(tree.density_values),
                "resolution": list(tree.resolution),
                "cascades": 1 + len(tree.outer),
                "ndc": tree.ndc is not None,
                "sh_degree": tree.degree,
                "load_s": round(loading, 3),
            },
            "memory": memory(tree, views[0]),
        }
    return result


def _in_process(task: dict[str, Any]) -> dict[str, Any]:
    """`measure_task` in a process of its own."""
    command = [sys.executable, str(HERE / "render.py"), "--task", json.dumps(task)]
    environment = os.environ | {"PYTHONPATH": task["checkout"]}
    told = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, encoding="utf-8").stdout
    answer: dict[str, Any] = json.loads(told.splitlines()[-1])
    return answer


def _mean(rounds: list[dict[str, Any]]) -> dict[str, float]:
    """The mean of what was measured in each round."""
    return {name: round(sum(each["speed"][name] for each in rounds) / len(rounds), 3) for name in rounds[0]["speed"]}


def compare(task: dict[str, Any], other: Path | None, rounds: int) -> dict[str, Any]:
    """A row of the results: the rounds' means of this checkout, and of another in turn with it."""
    before = os.getloadavg()
    mine, others = [], []
    for n in range(rounds):
        mine.append(_in_process(task | {"whole": n == 0}))
        if other is not None:
            others.append(_in_process(task | {"checkout": str(other.resolve())}))
    row = {name: task[name] for name in ("width", "height", "supersample", "normals", "frames", "threads")} | mine[0] | {"speed": _mean(mine)}
    if others:
        row["before"] = _mean(others)
        row["times_as_fast"] = round(row["before"]["mean_ms"] / row["speed"]["mean_ms"], 2)
    return row | {"load": {"before": before, "after": os.getloadavg()}}


def _size(text: str) -> tuple[int, int]:
    width, height = (int(side) for side in text.split("x"))
    return width, height


def _options() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("assets", type=Path, nargs="*")
    parser.add_argument("--whole-scene", action="store_true", help="render the made scene too")
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
    return parser


def main() -> int:
    parser = _options()
    given = parser.parse_args()
    if given.task:
        print(json.dumps(measure_task(given.task)))
        return 0
    sources = [*(str(asset.resolve()) for asset in given.assets), *([""] if given.whole_scene else [])]
    if not sources:
        parser.error("name assets, or --whole-scene")
    rows = []
    for source in sources:
        for width, height in given.sizes:
            for threads in given.threads:
                task = {"asset": source, "width": width, "height": height, "frames": given.frames, "fov": given.fov, "supersample": given.supersample}
                task |= {"normals": given.normals}
                rows.append(compare(task | {"threads": threads, "checkout": str(HERE.parent), "whole": False}, given.against, given.rounds))
                row = rows[-1]
                ratio = f", {row['times_as_fast']} times as fast as before" if given.against else ""
                print(f"{row['asset']['name']} {width}x{height}, {threads} threads: {row['speed']['frames_per_s']} frames a second{ratio}", flush=True)
    result = {
        "date": datetime.date.today().isoformat(),
        "renders": rows,
        "machine": {"processor": processor(), "cores": os.cpu_count(), "platform": platform.platform(), "memory": bandwidth()},
        "versions": {name: version(name) for name in ("numba", "numpy", "llvmlite")} | {"python": platform.python_version()},
    }
    given.json.parent.mkdir(parents=True, exist_ok=True)
    given.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(f"written to {given.json}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
