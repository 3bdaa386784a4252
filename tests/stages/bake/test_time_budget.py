"""A bake with a budget of seconds: phases that take their shares of it, and steps that give the same asset again. The clock is a made one."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.asset import format
from efficientnerf.asset.refinement import fit
from efficientnerf.asset.refinement.schedule import PHASES, recorded_schedule
from efficientnerf.asset.refinement.state import RefinementState
from efficientnerf.asset.tree import NerfTree
from pipeline.errors import Interrupted
from pipeline.stage import Job
from stages.artifacts import BakeOutputs
from stages.bake import run as bake
from stages.bake.refine import refinement, timing
from stages.bake.resolution import MAX_MIB, timed_mib
from stages.bake.settings import BakeSettings
from stages.train.log import read_lines
from tests.stages.balls import StopAt, job

SECONDS = 60.0
QUICK = BakeSettings(resolution=16, samples_per_voxel=1, visibility_rays=1000, refine_rays_per_batch=64, time_budget=SECONDS)


@pytest.fixture(autouse=True)
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """A step takes a second in the first phase and half of one after it; the weights of voxels two."""
    time, steps, weights = [0.0], fit.optimise, fit.max_weights

    def timed(state: RefinementState, *rest: Any, **more: Any) -> Iterator[float]:
        first = not hasattr(timed, "pruned")
        for error in steps(state, *rest, **more):
            time[0] += 1.0 if first else 0.5
            yield error

    def weighed(*given: Any) -> np.ndarray:
        time[0] += 2.0
        timed.pruned = True  # type: ignore[attr-defined]
        return weights(*given)

    for module in (refinement, timing):
        monkeypatch.setattr(module, "clock", lambda: time[0])
    monkeypatch.setattr(fit, "optimise", timed)
    monkeypatch.setattr(fit, "max_weights", weighed)
    return time


def asset(made: Job) -> NerfTree:
    return format.load(made.out / BakeOutputs.asset)


def fitted(made: Job) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((made.out / BakeOutputs.report).read_text())["optimisation"]
    return found


def assert_same(one: NerfTree, other: NerfTree) -> None:
    np.testing.assert_array_equal(one.voxel_index, other.voxel_index)
    np.testing.assert_array_equal(one.density_values, other.density_values)
    np.testing.assert_array_equal(one.sh, other.sh)


def repeated(folder: Path, inputs: dict[str, Path], schedule: list[dict[str, Any]]) -> NerfTree:
    """The asset of a recorded schedule."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(refinement, "stated_schedule", lambda steps: recorded_schedule(schedule))
        made = job(folder, replace(QUICK, time_budget="off"), **inputs)
        bake.run(made)
    assert fitted(made)["schedule"] == schedule
    return asset(made)


def test_the_budget_is_met_and_its_steps_give_the_same_asset(inputs: dict[str, Path], tmp_path: Path, now: list[float]) -> None:
    made = job(tmp_path / "a", QUICK, **inputs)
    bake.run(made)
    said = fitted(made)
    assert 0.9 * SECONDS <= now[0] <= SECONDS
    first, second = (one["iterations"] for one in said["schedule"])
    assert first == pytest.approx(PHASES[0].share * SECONDS, abs=1)  # of a second each
    assert second == pytest.approx((SECONDS - first - 2) / 0.5, abs=2)  # what is left after the pruning
    assert said["steps"] == first + second
    assert made.facts["schedule"] == said["schedule"]
    assert_same(asset(made), repeated(tmp_path / "b", inputs, said["schedule"]))
    lines = read_lines(made.out / BakeOutputs.log)
    assert lines[0]["step"] == 0
    assert lines[-1]["step"] == said["steps"]
    assert {line["phase"] for line in lines} == {phase.name for phase in PHASES}
    drawn = [line["step"] for line in lines if line["preview_psnr"] is not None]
    assert 3 <= len(drawn) <= 9
    assert [path.name for path in sorted((made.out / BakeOutputs.previews).iterdir())] == [f"preview_{step:06d}.png" for step in drawn]


@pytest.mark.parametrize("at", [4, 25])
def test_an_interrupted_bake_keeps_to_its_plan(inputs: dict[str, Path], tmp_path: Path, now: list[float], at: int) -> None:
    """Stopped before and after the number of steps of the first phase is set, and in the second."""
    never = StopAt()
    bake.run(job(tmp_path / "whole", replace(QUICK, time_budget="off", refine_steps=2), stop=never, **inputs))
    before = never.count - 3  # two steps, and one block of rays for the weights
    now[0] = 0.0
    stop = StopAt(before + at)
    with pytest.raises(Interrupted):
        bake.run(job(tmp_path, QUICK, stop=stop, **inputs))
    events: list[dict[str, Any]] = []
    made = job(tmp_path, QUICK, stop=stop, events=events, **inputs)
    bake.run(made)
    assert [event["text"] for event in events if "resuming" in event.get("text", "")] == [f"resuming the refinement from step {at}"]
    assert 0.9 * SECONDS <= now[0] <= SECONDS
    steps = [line["step"] for line in read_lines(made.out / BakeOutputs.log)]
    assert steps == sorted(set(steps))
    assert_same(asset(made), repeated(tmp_path / "again", inputs, fitted(made)["schedule"]))


def test_an_asset_is_no_larger_than_the_time_refines(inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def limit(made: Job) -> float:
        return float(json.loads((made.out / BakeOutputs.report).read_text())["max_mib"])

    def baked(folder: str, **changed: Any) -> Job:
        made = job(tmp_path / folder, replace(QUICK, **changed), **inputs)
        bake.run(made)
        return made

    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    assert limit(baked("a minute")) == timed_mib(MAX_MIB, SECONDS, 2, whole=False) < MAX_MIB
    assert limit(baked("stated", max_mib=20)) == 20
    assert limit(baked("steps", time_budget="off", refine_steps=2)) == MAX_MIB
    stopped = job(tmp_path / "stopped", QUICK, stop=StopAt(3), **inputs)
    with pytest.raises(Interrupted):
        bake.run(stopped)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    resumed = job(tmp_path / "stopped", QUICK, **inputs)
    bake.run(resumed)
    assert limit(resumed) == timed_mib(MAX_MIB, SECONDS, 2, whole=False)  # the cores of the first attempt
