"""Speed of rendering an asset on the CPU, and what bounds it: written to benchmarks/results/render_cpu.json.

    python benchmarks/render.py ASSET [--width 800 --height 800] [--frames 24] [--threads N] [--json FILE]
    python benchmarks/render.py --whole-scene --width 640 --height 480

Cameras are spread evenly on the asset's orbit, or inside of the scene that `whole_scene.py` makes, of nested grids. Besides frames a second: samples and
colours of a ray, the bytes that they read, the measured bandwidth of the memory, and the load average.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
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
    from stages.framing.camera_paths import turntable_cameras

    return list(turntable_cameras(tree, frames=count, width=width, height=height, fov=fov))


def measure(tree: Any, views: list[Any], supersample: int) -> dict[str, Any]:
    from efficientnerf.asset.rendering import render

    """Times of each render, after one that compiles and packs; `processor_ms` is the time of all cores together for one."""
    first = _seconds(lambda: render(tree, views[0], supersample=supersample))
    spent = time.process_time()
    took = [_seconds(lambda view=view: render(tree, view, supersample=supersample)) for view in views]
    again = [_seconds(lambda view=view: render(tree, view, supersample=supersample)) for view in views]
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


def counts(tree: Any, views: list[Any]) -> dict[str, float]:
    """Means over the rays of some renders: what the kernel looks up, and the bytes that it reads, most of them from caches."""
    import numpy as np

    from efficientnerf.backends.numba.tree.rendering import ray_statistics

    work = np.concatenate([ray_statistics(tree, view).reshape(-1, 4) for view in views[:: max(1, len(views) // 3)][:3]])
    cells, tested, mixed, colours = (float(n) for n in work.mean(axis=0))
    # A cell is 4 bytes, and so is a mask; an interpolated sample reads four rows, and the four numbers of eight voxels, colours among them.
    read = 4 * cells + 4 * tested + (4 * 8 + 8 * 16) * mixed
    return {
        "cells_per_ray": round(cells, 3),
        "samples_per_ray": round(tested, 3),
        "samples_with_density_per_ray": round(mixed, 3),
        "colours_per_ray": round(colours, 3),
        "bytes_per_ray": round(read, 1),
        "rays_that_hit": round(float((work[:, 3] > 0).mean()), 4),
    }


def memory(tree: Any, view: Any) -> dict[str, float]:
    """Bytes in memory while rendering: the tree, its packed form, the colours of the view, and the framebuffer."""
    from efficientnerf.asset.rendering import render
    from efficientnerf.backends.numba.tree.packed import packed_of
    from efficientnerf.backends.numba.tree.rendering import scratch_bytes

    values = vars(tree) | vars(tree.harmonics) if hasattr(tree.harmonics, "__dict__") else vars(tree)
    own = sum(part.nbytes for part in values.values() if hasattr(part, "nbytes") and not isinstance(part, tuple))
    rendering = render(tree, view)
    framebuffer = sum(part.nbytes for part in vars(rendering).values())
    total = own + packed_of(tree).nbytes + scratch_bytes(tree) + framebuffer
    each = round(total / max(1, len(tree.density_values)), 1)
    packed = packed_of(tree).nbytes
    return {"tree": own, "packed": packed, "view_colours": scratch_bytes(tree), "framebuffer": framebuffer, "total": total, "bytes_per_voxel": each}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("asset", type=Path, nargs="?")
    what.add_argument("--whole-scene", action="store_true", help="render the made scene")
    parser.add_argument("--width", type=int, default=800)
    parser.add_argument("--height", type=int, default=800)
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--fov", type=float, default=39.6, help="vertical, degrees; by default that of the Realistic Synthetic scenes")
    parser.add_argument("--supersample", type=int, default=1)
    parser.add_argument("--threads", type=int, help="of numba; all cores by default")
    parser.add_argument("--json", type=Path, help="results/render_cpu.json or results/render_whole_scene_cpu.json by default")
    given = parser.parse_args()
    given.json = given.json or HERE / "results" / ("render_whole_scene_cpu.json" if given.whole_scene else "render_cpu.json")
    if given.threads is not None:
        os.environ["NUMBA_NUM_THREADS"] = str(given.threads)
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    sys.path.insert(0, str(HERE.parent))

    import numba
    import whole_scene

    from efficientnerf.asset import format

    before = os.getloadavg()
    begin = time.perf_counter()
    tree = whole_scene.whole_scene() if given.whole_scene else format.load(given.asset)
    loading = time.perf_counter() - begin
    size = given.width, given.height, given.frames
    views = whole_scene.cameras(*size) if given.whole_scene else cameras(tree, *size, given.fov)
    result = {
        "date": datetime.date.today().isoformat(),
        "asset": {
            "name": "made scene" if given.whole_scene else given.asset.name,
            "bytes": 0 if given.whole_scene else given.asset.stat().st_size,
            "voxels": len(tree.density_values),
            "resolution": list(tree.resolution),
            "cascades": 1 + len(tree.outer),
            "sh_degree": tree.degree,
            "load_s": round(loading, 3),
        },
        "image": {"width": given.width, "height": given.height, "supersample": given.supersample, "frames": given.frames},
        "speed": measure(tree, views, given.supersample),
        "work": counts(tree, views),
        "memory": memory(tree, views[0]),
        "machine": {
            "processor": processor(),
            "cores": os.cpu_count(),
            "threads": numba.get_num_threads(),
            "platform": platform.platform(),
            "memory": bandwidth(),
            "load": {"before": before, "after": os.getloadavg()},
        },
        "versions": {name: version(name) for name in ("numba", "numpy", "llvmlite")} | {"python": platform.python_version()},
    }
    result["speed"]["read_gb_per_s"] = round(result["work"]["bytes_per_ray"] * result["speed"]["rays_per_s"] / 1e9, 1)
    given.json.parent.mkdir(parents=True, exist_ok=True)
    given.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(result, indent=1))
    print(f"written to {given.json}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
