"""A budget of seconds becomes a number of steps that gives the same bytes again; the clock is a made one."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from efficientnerf.training import loop
from efficientnerf.training.loop import Progress, Trainer
from efficientnerf.training.settings import TrainSettings
from pipeline.errors import Interrupted
from pipeline.stage import Job
from stages import train
from stages.artifacts import TrainOutputs
from stages.io.field_file import load_renderer
from stages.training.budget import MOST, TIMED, Budget
from tests.efficientnerf.balls import settings
from tests.stages.balls import StopAt, job, poses

QUICK: dict[str, Any] = {
    "checkpoint_every": 10, "sample_batch_size": 512, "occupancy_warmup_steps": 4, "preview_every": "off", "iterations": 5, "time_budget": 40.0,
}  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return poses(tmp_path_factory.mktemp("budget") / "poses")


@pytest.fixture(autouse=True)
def made_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A step takes half a second, or two in the warm-up; nothing else takes any time."""
    now, steps = [0.0], loop.train

    def timed(t: Trainer, *rest: Any) -> Iterator[Progress]:
        for done in steps(t, *rest):
            now[0] += 2.0 if done.step <= QUICK["occupancy_warmup_steps"] else 0.5
            yield done

    monkeypatch.setattr(train, "clock", lambda: now[0])
    monkeypatch.setattr(loop, "train", timed)
    monkeypatch.setattr("stages.pictures.plots.curve", lambda path, *_, **__: path.write_bytes(b""))


def digest(made: Job) -> str:
    train.run(made)
    return hashlib.sha256((made.out / TrainOutputs.field).read_bytes()).hexdigest()


def report(made: Job) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((made.out / "report.json").read_text())
    return found


def repeated(said: dict[str, Any]) -> TrainSettings:
    """The settings of a plain run, as the report names them."""
    return replace(settings(**QUICK), time_budget="off", iterations=said["iterations"], rate_hold=said["rate_hold"], rate_aims=tuple(said["rate_aims"]))


def test_the_budget_is_met_and_its_steps_give_the_same_bytes(scene: Path, tmp_path: Path) -> None:
    budgeted = job(tmp_path / "a", settings(**QUICK), poses=scene)
    first = digest(budgeted)
    said = report(budgeted)
    assert said["iterations"] > QUICK["occupancy_warmup_steps"] + TIMED  # it was long enough to be planned
    assert 0.95 * QUICK["time_budget"] <= said["seconds"] <= QUICK["time_budget"]
    assert len(said["rate_aims"]) >= 2  # settled anew on the way
    aims = json.dumps(said["rate_aims"], separators=(",", ":"))
    steps = f"--set train.iterations={said['iterations']} --set train.rate_hold={said['rate_hold']}"
    assert said["again"] == f"--set train.time_budget=off {steps} --set train.rate_aims={aims}"
    plain = repeated(said)
    assert digest(job(tmp_path / "b", plain, poses=scene)) == first
    assert load_renderer(budgeted.out).model.settings == plain


@pytest.mark.parametrize("at", [6, 51, 60])
def test_an_interrupted_run_keeps_to_its_plan(scene: Path, tmp_path: Path, at: int) -> None:
    """Stopped before and after the number of steps is fixed."""
    stop = StopAt(at)
    with pytest.raises(Interrupted):
        train.run(job(tmp_path, settings(**QUICK), poses=scene, stop=stop))
    plan = tmp_path / "work" / "plan.json"
    assert plan.exists() == (at > QUICK["occupancy_warmup_steps"] + TIMED)
    again = job(tmp_path, settings(**QUICK), poses=scene, stop=stop)
    first = digest(again)
    said = report(again)
    assert 0.95 * QUICK["time_budget"] <= said["seconds"] <= QUICK["time_budget"]  # what was spent before counts
    plain = repeated(said)
    assert digest(job(tmp_path / "plain", plain, poses=scene)) == first


def test_a_budget_that_is_over_before_anything_is_timed_ends_the_training(scene: Path, tmp_path: Path) -> None:
    made = job(tmp_path, settings(**{**QUICK, "time_budget": 2.0}), poses=scene)
    train.run(made)
    assert 1 <= report(made)["iterations"] < QUICK["occupancy_warmup_steps"] + TIMED
    assert load_renderer(made.out).model.settings.iterations == report(made)["iterations"]


def test_steps_are_counted_from_those_after_the_warm_up(tmp_path: Path) -> None:
    """The warm-up's steps are slower than those that follow, and say nothing about them."""
    now = [0.0]
    budget = Budget(settings(occupancy_warmup_steps=10, time_budget=100.0), tmp_path, 0.0, lambda: now[0])
    assert budget.planned().iterations == MOST
    fixed = None
    for step in range(1, 100):
        now[0] += 3.0 if step <= 10 else 0.5
        if (fixed := budget.after(step)) is not None:
            break
    assert step == 10 + TIMED
    assert fixed is not None
    assert fixed.iterations == step + int((99 - 54) / 0.5)
    assert Budget(settings(occupancy_warmup_steps=10, time_budget=100.0), tmp_path, 54.0, lambda: 0.0).planned() == fixed
    (tmp_path / "plan.json").write_text("{")
    assert Budget(settings(occupancy_warmup_steps=10, time_budget=100.0), tmp_path, 54.0, lambda: 0.0).planned().iterations == MOST


PACES: dict[str, Callable[[int], float]] = {
    "dearer": lambda step: 0.2 + step / 2000,
    "cheaper": lambda step: 0.5 - step / 2000,
    "sudden": lambda step: 0.3 if step < 200 else 0.2,
}


@pytest.mark.parametrize("pace", PACES.values(), ids=PACES)
@pytest.mark.parametrize("stops", [(), (40, 90, 300), (61, 62, 63)])
def test_steps_that_change_their_pace_end_on_time(tmp_path: Path, pace: Callable[[int], float], stops: tuple[int, ...]) -> None:
    """Also where attempts are interrupted and go on from a checkpoint ten steps before."""
    times, step, spent, began = [0.0], 0, 0.0, 0.0
    given = settings(occupancy_warmup_steps=10, time_budget=120.0)
    budget = Budget(given, tmp_path, 0.0, lambda: times[-1])
    planned = budget.planned()
    lost: dict[int, TrainSettings] = {}  # what the steps after the checkpoint were taken with
    while step < planned.iterations:
        if step in stops and step not in lost:
            lost[step] = planned
            step -= 10
            spent, began = spent + times[-1] - began, times[-1]
            budget = Budget(given, tmp_path, spent, lambda: times[-1])
            planned = budget.planned()
        before = rate(step + 1, planned)
        times.append(times[-1] + pace(step))
        step += 1
        planned = budget.after(step) or planned
        assert rate(step, planned) == pytest.approx(before, abs=1e-6)  # what is settled later changes nothing that has been done
    assert 0.97 * 120 < spent + times[-1] - began <= 120 * 1.005
    assert rate(step, planned) == pytest.approx(1.0)


def rate(step: int, s: TrainSettings) -> float:
    return loop.share_of_fall(step, s.iterations, s.rate_hold, s.rate_aims)
