"""Small real scenes, some broken on purpose: one by one with `enerf run`, then as fleets on local Dask clusters of one worker and of two, one core each."""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.torture import sources
from workflows.asset import NAMES

SETTINGS = tuple(setting for setting in sources.SETTINGS if not setting.startswith("splats."))
ONE_CORE = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}


def _without_images(folder: Path) -> None:
    for path in folder.glob("*/*.png"):
        path.unlink()


def _with_half_a_document(folder: Path) -> None:
    path = folder / "transforms_train.json"
    path.write_bytes(path.read_bytes()[:100])


def _without_cameras(folder: Path) -> None:
    path = folder / "transforms_train.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "frames": []}))


BREAKS: tuple[tuple[str, Callable[[Path], None]], ...] = (
    ("no images", _without_images), ("half a document", _with_half_a_document), ("no cameras", _without_cameras),
)  # fmt: skip


def make(folder: Path, count: int) -> tuple[Path, dict[str, str]]:
    """A manifest of so many scenes, each with a seed of its own, and which of them are broken how: a tenth, at least one."""
    shoots = folder / "shoots"
    source = sources.make("blender", folder / "made").folder
    broken, lines = {}, ['preset = "tiny"']
    for number in range(count):
        name = f"s{number:02d}"
        shutil.copytree(source, shoots / name)
        lines += [f"[scenes.{name}]", f'source = "shoots/{name}"', f"seed = {number}", 'as = "blender"']
        for setting in SETTINGS:
            lines.append(setting.replace("=", " = ", 1))
    for number in range(max(1, round(count / 8))):
        name, (how, action) = f"s{8 * number % count:02d}", BREAKS[number % len(BREAKS)]
        action(shoots / name)
        broken[name] = how
    (folder / "scenes.toml").write_text("\n".join(lines) + "\n")
    return folder / "scenes.toml", broken


def compare(folder: Path, count: int) -> dict[str, Any]:
    """Each way, its seconds and processor time; whether what it made is the same."""
    folder.mkdir(parents=True)
    manifest, broken = make(folder, count)
    options = [word for setting in SETTINGS for word in ("--set", setting)]

    def one_by_one() -> None:
        for number in range(count):
            source, run = folder / "shoots" / f"s{number:02d}", folder / "alone" / f"s{number:02d}"
            more = ["--preset", "tiny", "--as", "blender", "--seed", str(number), "--device", "cpu", "--quiet", *options]
            code = _enerf("run", source, "--out", run, *more)
            assert (code != 0) == (run.name in broken), f"{run.name} ended with {code}"

    def on_workers(workers: int) -> Callable[[], None]:
        def run() -> None:
            cluster = folder / f"workers{workers}.toml"
            cluster.write_text(f"n_workers = {workers}\n")
            _enerf("fleet", manifest, "--out", folder / f"fleet{workers}", "--device", "cpu", "--quiet", "--cluster", "local", "--cluster-options", cluster)

        return run

    ways = {"one_by_one": one_by_one, "one_worker": on_workers(1), "two_workers": on_workers(2)}
    found: dict[str, Any] = {"scenes": count, "broken": broken, **{name: _measured(way) for name, way in ways.items()}}
    for name, place in (("one_worker", folder / "fleet1"), ("two_workers", folder / "fleet2")):
        state = json.loads((place / "fleet.json").read_text())
        scenes = {scene["name"]: scene for scene in state["scenes"]}
        found[name] |= {"totals": state["totals"], "reasons": {scene: scenes[scene]["reason"] for scene in broken}}
        good = [scene for scene in scenes if scene not in broken]
        found[name]["digests_equal"] = all(_digests(place / scene) == _digests(folder / "alone" / scene) for scene in good)
    return found


def _enerf(*arguments: Any) -> int:
    command = [sys.executable, "-m", "workflows.cli.main", *map(str, arguments)]
    return subprocess.run(command, env={**os.environ, **ONE_CORE}, stderr=subprocess.DEVNULL, check=False).returncode


def _measured(way: Callable[[], None]) -> dict[str, float]:
    began, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    way()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds, busy = time.monotonic() - began, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"seconds": seconds, "cpu_seconds": busy, "cores_busy": busy / seconds}


def _digests(run: Path, stages: Sequence[str] = NAMES) -> list[str | None]:
    paths = [run / stage / "manifest.json" for stage in stages]
    return [json.loads(path.read_bytes())["digest"] if path.exists() else None for path in paths]
