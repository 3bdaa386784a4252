"""Fuzzing of the asset format: files of every layout, valid or changed at random, must be read or refused; and what is read, be rendered and converted.

    python benchmarks/fuzz_format.py [--inputs 100000] [--seed 0] [--workers 1] [--json FILE]

Mutations (`benchmarks/format_mutations.py`): bytes anywhere; bytes of the header; JSON values of the header and the metadata, valid or nearly so; bytes, or all
values, of tensors; numbers that places follow from; and sound files of odd proportions, made from nothing. In the last four the digests are right, so
that what comes after them is reached. Files that are read are described, rendered from inside, outside, far away, along a face and by odd lenses, looked up at
points, meshed and written in another layout.

A child process runs each batch, its address space limited to 1 GiB more than after its imports. Each input is written to disk before it is opened, so
that an input that kills the child is known; one that stands still is ended. Failures are: any exception but FormatError, a child that
dies, a step that takes more than SLOW seconds. The same seed gives the same inputs.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from format_mutations import Rng, built, changed, number
from machine import processor

HERE = Path(__file__).resolve().parent
GOLDEN = HERE.parent / "tests" / "data" / "golden"
EXTRA_MEMORY = 2**30  # bytes of address space beyond what the imports took
SLOW = 5  # seconds of a step
BATCH = 10_000
MOST_CONVERTED = 2000  # voxels of assets whose palettes are sought: that takes seconds of honest work for more
SIZE = 16  # pixels along a side of a picture


class TooSlow(BaseException):
    """A step that takes more than SLOW seconds; no library takes it for an error of its own."""


@contextmanager
def step(name: str, took: dict[str, float]) -> Iterator[None]:
    """A step of at most SLOW seconds of the processor, and the most that it took so far: other programs may run beside."""
    signal.setitimer(signal.ITIMER_PROF, SLOW)
    begin = time.process_time()
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        took[name] = max(took.get(name, 0.0), time.process_time() - begin)


def pose(forward: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Camera to world."""
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.9 else [1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    out = np.eye(4)
    out[:3, 0], out[:3, 1], out[:3, 2], out[:3, 3] = right, np.cross(forward, right), forward, centre
    return out


def views(tree: Any, rng: Rng) -> Iterator[Any]:
    """Cameras inside, outside, far and very far away, on a face, beside and behind; lenses from a point to the whole sky, with and without distortion."""
    from efficientnerf.geometry.cameras import Camera

    outermost = tree.outer[-1].bounds(tree.brick) if tree.outer and number(rng, 2) else (tree.bounds_min, tree.bounds_max)
    low, high = outermost
    middle, extent = (low + high) / 2, float(np.max(high - low))
    if tree.ndc is not None:  # of the world: before the near plane
        middle, extent = tree.ndc.world_from_camera[:3, 3], float(tree.ndc.near)
    towards = rng.normal(size=3)
    places = [
        (towards, middle), (towards, middle - towards / np.linalg.norm(towards) * extent * 2), (towards, middle - towards * extent * 1e6),
        (towards, middle - towards * extent * float(10.0 ** rng.uniform(6, 20))), (np.eye(3)[number(rng, 3)], low), (np.array([1.0, 1e-9, 0]), high),
        (-towards, middle - towards * extent * 3), (np.eye(3)[number(rng, 3)], middle - np.eye(3)[number(rng, 3)] * extent),
    ]  # fmt: skip
    chosen = rng.permutation(len(places))[:2]
    for n in chosen:
        forward, centre = places[n]
        focal = float([SIZE, SIZE, 1e-6, 1e9, 10.0 ** rng.uniform(-12, 12)][number(rng, 5)])
        lens: tuple[str, tuple[float, ...]] = ("SIMPLE_PINHOLE", (focal, SIZE / 2, SIZE / 2))
        if not number(rng, 4):
            lens = ("OPENCV_FISHEYE", (focal, focal, SIZE / 2, SIZE / 2, *(float(x) for x in rng.normal(size=4) * 0.1)))
        yield Camera("view", SIZE, SIZE, *lens, pose(forward, centre))


def checked(rendering: Any) -> None:
    """Opacities are those of pictures; nothing is NaN where the asset has finite values."""
    if not (np.isfinite(rendering.opacity).all() and (rendering.opacity >= -1e-6).all() and (rendering.opacity <= 1 + 1e-6).all()):
        raise AssertionError("an opacity outside of 0 to 1")
    if not np.isfinite(rendering.colour).all():
        raise AssertionError("a colour that is not finite")


def draw(tree: Any, rng: Rng, took: dict[str, float]) -> None:
    from efficientnerf.asset import queries
    from efficientnerf.asset.rendering import render

    for camera in views(tree, rng):
        with step("render", took):
            checked(render(tree, camera, supersample=1 + (not number(rng, 8))))
    with step("queries", took):
        points = np.concatenate([rng.uniform(-1, 1, (8, 3)), rng.normal(size=(8, 3)) * 10.0 ** rng.uniform(-20, 20, (8, 1)), [[np.nan] * 3, [np.inf] * 3]])
        queries.density_at(tree, points), queries.normal_at(tree, points)
        queries.colour_at(tree, points, np.tile([0.0, 0.0, 1.0], (len(points), 1)))


def use(tree: Any, rng: Rng, took: dict[str, float]) -> None:
    """All that is done with an asset: rendered, and sometimes turned, meshed and converted. FormatError where a layout cannot hold it."""
    from efficientnerf.asset.conversion import pruned, with_degree, with_resolution
    from efficientnerf.asset.format import WRITERS, FormatError, serialize
    from efficientnerf.asset.region import cropped, foreground
    from efficientnerf.geometry.cameras import Similarity
    from efficientnerf.surface.extraction import points, surface
    from efficientnerf.surface.isosurface import NoSurface
    from efficientnerf.surface.volume import volume_of
    from pipeline.errors import BadInput
    from stages.framing.camera_paths import turntable_cameras

    draw(tree, rng, took)
    if not number(rng, 4):
        with step("region", took):
            identity = Similarity(1.0, np.eye(3), np.zeros(3))
            for part in (foreground(tree), cropped(tree, rng.uniform(tree.bounds_min, tree.bounds_max, (2, 3)), identity)):
                draw(part, rng, {})
    if not number(rng, 4):
        with step("turntable", took), suppress(BadInput):
            for camera in turntable_cameras(tree, frames=2, width=SIZE, height=SIZE):
                checked(draw_one(tree, camera))
    if not number(rng, 6):
        with step("surface", took), suppress(NoSurface):
            level = None if number(rng, 2) else float(10.0 ** rng.uniform(-3, 4))
            volume = volume_of(tree)
            surface(volume, level, faces=200) if number(rng, 2) else points(volume, 100, level)
    if not number(rng, 4):
        with step("convert", took):
            smaller = [lambda: with_degree(tree, number(rng, tree.degree + 1)), lambda: pruned(tree), lambda: tree][number(rng, 3)]()
            if max(tree.resolution) <= 64 and not number(rng, 2):
                most = max(tree.resolution)
                divisors = [n for n in range(1, tree.brick + 1) if tree.brick % n == 0]
                smaller = with_resolution(smaller, most // divisors[number(rng, len(divisors))] if tree.outer else 1 + number(rng, most))
            with suppress(FormatError):
                serialize(smaller, [None, *WRITERS][number(rng, 1 + len(WRITERS))] if len(tree.density_values) <= MOST_CONVERTED else None)


def draw_one(tree: Any, camera: Any) -> Any:
    from efficientnerf.asset.rendering import render

    return render(tree, camera)


def try_file(path: Path, rng: Rng, took: dict[str, float]) -> str | None:
    """None if the file is read and used; else the reason why it is refused. Anything else is raised."""
    from efficientnerf.asset.format import FormatError, describe, load

    refusal = None
    with step("describe", took):
        try:
            describe(path)
        except FormatError as error:
            refusal = str(error)
    with step("load", took):
        try:
            tree = load(path)
        except FormatError as error:
            return str(error)
    if refusal is not None:
        raise AssertionError(f"read, but not described: {refusal}")
    with np.errstate(all="ignore"):
        use(replace(tree), rng, took)
    return None


def rule(message: str) -> str:
    """The message without what is specific to this file, so that equal refusals count as one."""
    return re.sub(r"'[^']*'|SHA-256.*|[0-9]+|\(.*\)", "*", message.partition(": ")[2])[:60]


def batch(seed: int, first: int, count: int, folder: Path, keep: Path | None) -> dict[str, Any]:
    """Inputs `first` to `first + count` - 1, in this process."""
    seeds = [path.read_bytes() for path in sorted(GOLDEN.glob("*.nerftree"))]
    path = folder / "fuzzed.nerftree"
    kinds: Counter[str] = Counter()
    refusals: Counter[str] = Counter()
    took: dict[str, float] = {}
    used: Counter[str] = Counter()
    failures: list[dict[str, Any]] = []

    def alarm(*_: Any) -> None:
        raise TooSlow(f"more than {SLOW} s")

    signal.signal(signal.SIGPROF, alarm)
    for index in range(first, first + count):
        rng = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 0, index]))
        kind, data = changed(rng, seeds)
        path.write_bytes(data)
        (folder / "index").write_text(str(index))
        try:
            refusal = try_file(path, rng, took)
        except (Exception, TooSlow) as error:
            frames = [f"{Path(frame.filename).name}:{frame.lineno}" for frame in traceback.extract_tb(error.__traceback__)[-4:]]
            failures.append({"index": index, "kind": kind, "error": f"{type(error).__name__}: {error}"[:300], "at": frames})
            if keep is not None:
                (keep / f"{index}.nerftree").write_bytes(data)
            refusal = "failed"
        kinds[kind] += 1
        if refusal is None:
            used[kind] += 1
        else:
            refusals[rule(refusal)] += 1
    return {"inputs": count, "kinds": dict(kinds), "read": dict(used), "refusals": dict(refusals), "slowest_s": took, "failures": failures,
            "peak_rss_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024}  # fmt: skip


def warm_up() -> None:
    """Compiles or loads the kernels, which no step's time is to hold."""
    rng = np.random.Generator(np.random.Philox(key=1))
    signal.signal(signal.SIGPROF, signal.SIG_IGN)
    for path in sorted(GOLDEN.glob("*.nerftree")):
        for _ in range(6):
            try_file(path, rng, {})
    with tempfile.TemporaryDirectory() as folder:  # what no golden file holds, forward-facing assets by any camera among it
        path = Path(folder) / "built.nerftree"
        for _ in range(40):
            path.write_bytes(built(rng))
            try_file(path, rng, {})


def child(seed: int, first: int, count: int, folder: Path, keep: Path | None) -> None:
    """Imports and loads kernels, then limits its memory, then works."""
    import warnings

    sys.path.insert(0, str(HERE.parent))
    warm_up()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if Path("/proc/self/statm").exists() else 0
    if pages:
        limit = pages * resource.getpagesize() + EXTRA_MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    warnings.simplefilter("error")
    print(json.dumps({**batch(seed, first, count, folder, keep), "rss_before_mib": before}), flush=True)


def attended(seed: int, first: int, count: int, keep: Path | None) -> list[dict[str, Any]]:
    """Results of a batch's children: another goes on behind an input that one died of."""
    found: list[dict[str, Any]] = []
    end = first + count
    while first < end:
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, __file__, "--seed", str(seed), "--child", str(first), str(end - first), "--folder", folder]
            command += [] if keep is None else ["--keep", str(keep)]
            code, out, error = watched(command, Path(folder) / "index")
            if code == 0:
                return [*found, json.loads(out)]
            at = int((Path(folder) / "index").read_text()) if (Path(folder) / "index").exists() else first
            if keep is not None and (Path(folder) / "fuzzed.nerftree").exists():
                (keep / f"{at}.nerftree").write_bytes((Path(folder) / "fuzzed.nerftree").read_bytes())
            found.append({"failures": [{"index": at, "error": f"the process ended with {code}: {error[-300:]}"}]})
            first = at + 1
    return found


def watched(command: list[str], index: Path) -> tuple[int, str, str]:
    """Exit code, output and errors of a child, ended where its index stands still for twenty times SLOW."""
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as error:
        process = subprocess.Popen(command, stdout=out, stderr=error, env={**os.environ, "NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"})
        while process.poll() is None:
            time.sleep(0.2)
            if index.exists() and time.time() - index.stat().st_mtime > 20 * SLOW:
                process.kill()
        out.seek(0)
        error.seek(0)
        return process.returncode, out.read(), error.read()


def summary(found: list[dict[str, Any]], seed: int, seconds: float) -> dict[str, Any]:
    totals: dict[str, Counter[str]] = {name: Counter() for name in ("kinds", "read", "refusals")}
    slowest: dict[str, float] = {}
    for part in found:
        for name, total in totals.items():
            total.update(part.get(name, {}))
        for name, value in part.get("slowest_s", {}).items():
            slowest[name] = max(slowest.get(name, 0.0), value)
    return {
        "inputs": sum(part.get("inputs", 0) for part in found), "seed": seed, "kinds": dict(sorted(totals["kinds"].items())),
        "read": sum(totals["read"].values()), "read_by_kind": dict(sorted(totals["read"].items())), "refused": sum(totals["refusals"].values()),
        "failures": [failure for part in found for failure in part["failures"]],
        "slowest_s": {name: round(value, 3) for name, value in sorted(slowest.items())},
        "limit_s": SLOW, "peak_rss_mib": max((part.get("peak_rss_mib", 0) for part in found), default=0),
        "rss_before_mib": max((part.get("rss_before_mib", 0) for part in found), default=0), "room_mib": EXTRA_MEMORY // 2**20, "seconds": round(seconds),
        "date": datetime.date.today().isoformat(), "processor": processor(), "python": platform.python_version(), "numpy": np.__version__,
        "most_common_refusals": dict(totals["refusals"].most_common(40)),
    }  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=100_000)
    parser.add_argument("--first", type=int, default=0, help="number of the first input")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="folder for inputs that fail")
    parser.add_argument("--json", type=Path, default=HERE / "results" / "fuzz_format.json")
    parser.add_argument("--child", type=int, nargs=2, metavar=("FIRST", "COUNT"), help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child:
        child(given.seed, *given.child, given.folder, given.keep)
        return 0
    if given.keep is not None:
        given.keep.mkdir(parents=True, exist_ok=True)
    begin, found = time.time(), []
    end = given.first + given.inputs
    with ThreadPoolExecutor(given.workers) as pool:
        parts = [pool.submit(attended, given.seed, first, min(BATCH, end - first), given.keep) for first in range(given.first, end, BATCH)]
        for part in parts:
            found += part.result()
            print(f"{sum(each.get('inputs', 0) for each in found)} inputs, {sum(len(each['failures']) for each in found)} failures", flush=True)
    result = summary(found, given.seed, time.time() - begin)
    given.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(f"{result['inputs']} inputs: {result['read']} read, {result['refused']} refused, {len(result['failures'])} failures; "
          f"peak {result['peak_rss_mib']} MiB ({result['rss_before_mib']} after imports), slowest {result['slowest_s']}")  # fmt: skip
    return 1 if result["failures"] else 0


if __name__ == "__main__":
    sys.exit(main())
