"""Small real scenes, some broken on purpose: one by one with `enerf run`, then as fleets on local Dask clusters of one worker and of two, one core each.

Each way is measured by itself and leaves FOLDER/WAY.json; a call measures those that are missing, and compares what is there.
"""

from __future__ import annotations

import contextlib
import ctypes
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

WAYS = ("one_by_one", "one_worker", "two_workers")
# As small as every stage can bear, and then as much training, refinement and frames as make a scene of about 15 seconds on one core.
SIZES = {
    "train.iterations": 1000, "train.checkpoint_every": 500, "train.preview_every": 500, "train.max_rays_per_batch": 512, "bake.refine_steps": 60,
    "bake.refine_rays_per_batch": 1024, "turntable.frames": 16,
}  # fmt: skip
_SMALL = dict(setting.split("=", 1) for setting in sources.SETTINGS if not setting.startswith("splats."))
SETTINGS = tuple(f"{name}={value}" for name, value in {**_SMALL, **SIZES, "splats.make": '"off"'}.items())
ONE_CORE = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1", "OPENCV_FOR_THREADS_NUM": "1"}
_PR_SET_CHILD_SUBREAPER = 36  # prctl(2)


def _without_images(folder: Path) -> None:
    for path in folder.glob("*/*.png"):
        path.unlink()


def _with_half_a_document(folder: Path) -> None:
    path = folder / "transforms_train.json"
    path.write_bytes(path.read_bytes()[:100])


def _without_cameras(folder: Path) -> None:
    path = folder / "transforms_train.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "frames": []}))


# How a scene is broken, and what its reason has to say.
BREAKS: tuple[tuple[Callable[[Path], None], str], ...] = (
    (_without_images, "images are missing"), (_with_half_a_document, "not valid JSON"), (_without_cameras, "list of frames is empty"),
)  # fmt: skip


def make(folder: Path, count: int) -> None:
    """A manifest of so many scenes, each with a seed of its own."""
    shoots = folder / "shoots"
    source = sources.make("blender", folder / "made").folder
    lines = ['preset = "tiny"', *(setting.replace("=", " = ", 1) for setting in SETTINGS)]
    for number in range(count):
        name = f"s{number:02d}"
        shutil.copytree(source, shoots / name)
        lines += [f"[scenes.{name}]", f'source = "shoots/{name}"', f"seed = {number}", 'as = "blender"']
    for name, (action, _) in broken(count).items():
        action(shoots / name)
    (folder / "scenes.toml").write_text("\n".join(lines) + "\n")


def broken(count: int) -> dict[str, tuple[Callable[[Path], None], str]]:
    """Which scenes are broken: an eighth, at least one."""
    return {f"s{8 * number % count:02d}": BREAKS[number % len(BREAKS)] for number in range(max(1, round(count / 8)))}


def compare(folder: Path, count: int, ways: Sequence[str] = WAYS) -> dict[str, Any]:
    """Measure those of the ways that were not yet; compare all that were."""
    if not (folder / "scenes.toml").exists():
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        make(folder, count)
    actions = {"one_by_one": lambda: _one_by_one(folder, count), "one_worker": lambda: _on_workers(folder, 1), "two_workers": lambda: _on_workers(folder, 2)}
    found: dict[str, Any] = {"scenes": count, "broken": list(broken(count))}
    for way in WAYS:
        kept = folder / f"{way}.json"
        if way in ways and not kept.exists():
            shutil.rmtree(folder / way, ignore_errors=True)  # of a call that was cut short
            kept.write_text(json.dumps(_measured(actions[way])))
        if kept.exists():
            found[way] = json.loads(kept.read_text()) | _stages(folder / way, count)
    for way in ("one_worker", "two_workers"):
        if way in found:
            found[way] |= _outcome(folder, way, count, alone="one_by_one" in found)
    return found | _ratios(found)


def _one_by_one(folder: Path, count: int) -> None:
    options = [word for setting in SETTINGS for word in ("--set", setting)]
    for number in range(count):
        source, run = folder / "shoots" / f"s{number:02d}", folder / "one_by_one" / f"s{number:02d}"
        more = ["--preset", "tiny", "--as", "blender", "--seed", str(number), "--device", "cpu", "--quiet", *options]
        code = _enerf("run", source, "--out", run, *more)
        assert (code != 0) == (run.name in broken(count)), f"{run.name} ended with {code}"


def _on_workers(folder: Path, workers: int) -> None:
    way = WAYS[workers]
    cluster = folder / f"{way}.toml"
    cluster.write_text(f"n_workers = {workers}\n")
    code = _enerf("fleet", folder / "scenes.toml", "--out", folder / way, "--device", "cpu", "--quiet", "--cluster", "local", "--cluster-options", cluster)
    assert code == 3, f"{way} ended with {code}"


def _enerf(*arguments: Any) -> int:
    command = [sys.executable, "-m", "workflows.cli.main", *map(str, arguments)]
    return subprocess.run(command, env={**os.environ, **ONE_CORE}, stderr=subprocess.DEVNULL, check=False).returncode


def _measured(way: Callable[[], None]) -> dict[str, float]:
    """Seconds, and processor time: of all processes that the way has started, and of the whole machine with whatever else ran."""
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1)  # children of a worker that has ended are counted, too
    began, before, machine = time.monotonic(), _spent(), _machine_busy()
    way()
    seconds = time.monotonic() - began
    busy, machine = _spent() - before, _machine_busy() - machine
    return {"seconds": seconds, "cpu_seconds": busy, "cores_busy": busy / seconds, "machine_cores_busy": machine / seconds}


def _spent() -> float:
    with contextlib.suppress(ChildProcessError):
        deadline = time.monotonic() + 30.0
        while time.monotonic() < deadline:
            if os.waitpid(-1, os.WNOHANG) == (0, 0):
                time.sleep(0.05)
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _machine_busy() -> float:
    """Seconds of all cores together in which they did something."""
    user, nice, system, _, _, irq, softirq, *_ = map(int, Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:])
    return (user + nice + system + irq + softirq) / os.sysconf("SC_CLK_TCK")


def _stages(place: Path, count: int) -> dict[str, Any]:
    """What its stages took by their own count, and what of that was waiting."""
    made = [json.loads(path.read_bytes()) for path in place.glob("*/*/manifest.json")]
    seconds = {name: sum(each["seconds"] for each in made if each["request"]["stage"] == name) for name in NAMES}
    return {"stage_seconds": sum(seconds.values()), "stage_cpu_seconds": sum(each["cpu_seconds"] for each in made), "seconds_by_stage": seconds,
            "scenes_made": sum((place / f"s{number:02d}" / NAMES[-1] / "manifest.json").exists() for number in range(count))}  # fmt: skip


def _outcome(folder: Path, way: str, count: int, *, alone: bool) -> dict[str, Any]:
    """What became of the scenes; asserts that the broken ones, and they alone, are quarantined for what was broken."""
    state = json.loads((folder / way / "fleet.json").read_text())
    scenes = {scene["name"]: scene for scene in state["scenes"]}
    for name, scene in scenes.items():
        expected = broken(count).get(name)
        assert scene["state"] == ("done" if expected is None else "quarantined"), (name, scene["state"], scene["reason"])
        assert expected is None or expected[1] in scene["reason"], (name, scene["reason"])
    found: dict[str, Any] = {"totals": state["totals"], "reasons": {name: scenes[name]["reason"] for name in broken(count)}}
    if alone:
        found["digests_equal"] = all(_digests(folder / way / name) == _digests(folder / "one_by_one" / name) for name in scenes)
    return found


def _digests(run: Path, stages: Sequence[str] = NAMES) -> list[str | None]:
    paths = [run / stage / "manifest.json" for stage in stages]
    return [json.loads(path.read_bytes())["digest"] if path.exists() else None for path in paths]


def _ratios(found: dict[str, Any]) -> dict[str, float]:
    """What was asked: overhead of one worker over the loop, by the clock and by processor time; throughput of two workers over one."""
    loop, one, two = (found.get(way) for way in WAYS)
    made: dict[str, float] = {}
    if loop and one:
        made |= {"overhead": one["seconds"] / loop["seconds"] - 1, "overhead_cpu": one["cpu_seconds"] / loop["cpu_seconds"] - 1}
        outside = [way["seconds"] - way["stage_seconds"] for way in (loop, one)]
        made["overhead_outside_stages"] = (outside[1] - outside[0]) / loop["seconds"]
    if one and two:
        made["throughput"] = one["seconds"] / two["seconds"]
    return made
