"""A budget of seconds becomes a number of steps that gives the same bytes again; the clock is a made one."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from efficientnerf.model import model, state_of
from efficientnerf.training import loop
from efficientnerf.training.loop import Progress, Trainer
from efficientnerf.training.schedule import schedule_of
from pipeline.errors import Interrupted
from pipeline.stage import Job
from stages.artifacts import TrainOutputs
from stages.io.field_file import load_renderer, read_tensors, space_of
from stages.io.scene import load, views_of
from stages.train import run as train
from stages.train.budget import TIMED, training_budget
from stages.train.data import depth_range, pixels_of
from stages.train.hash_resolution import with_auto_sizes
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
    monkeypatch.setattr("stages.train.checks.wrong_views.train", timed)


def report(made: Job) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((made.out / "report.json").read_text())
    return found


def tensors_of(made: Job) -> dict[str, bytes]:
    """Those of the trained field."""
    return {name: tensor.numpy().tobytes() for name, tensor in state_of(load_renderer(made.out).model).items()}


def repeated(scene: Path, said: dict[str, Any]) -> dict[str, bytes]:
    """The tensors of a field that is trained with the schedule of the report."""
    s = load(scene)
    views = views_of(s, "train")
    pixels = pixels_of(scene, views)
    given = with_auto_sizes(settings(**QUICK), s, len(pixels))
    m = model(space_of(s), given, s.background, span=depth_range(s, pixels, given))
    t = loop.trainer(m, None, schedule_of(given, said["schedule"]))
    assert len(list(loop.train(t, pixels))) == said["iterations"]
    return {name: tensor.numpy().tobytes() for name, tensor in state_of(m).items()}


def test_the_budget_is_met_and_its_steps_give_the_same_bytes(scene: Path, tmp_path: Path) -> None:
    budgeted = job(tmp_path / "a", settings(**QUICK), poses=scene)
    train.run(budgeted)
    said = report(budgeted)
    assert said["iterations"] > QUICK["occupancy_warmup_steps"] + TIMED  # it was long enough to be planned
    assert 0.95 * QUICK["time_budget"] <= said["seconds"] <= QUICK["time_budget"]
    assert len(said["schedule"]["aims"]) >= 1  # set again on the way
    assert read_tensors(budgeted.out / TrainOutputs.field)[1]["schedule"] == said["schedule"]
    assert load_renderer(budgeted.out).model.settings.iterations == said["iterations"]
    assert repeated(scene, said) == tensors_of(budgeted)


@pytest.mark.parametrize("at", [6, 60])
def test_an_interrupted_run_keeps_to_its_plan(scene: Path, tmp_path: Path, at: int) -> None:
    """Stopped before and after the number of steps is fixed."""
    stop = StopAt(at)
    with pytest.raises(Interrupted):
        train.run(job(tmp_path, settings(**QUICK), poses=scene, stop=stop))
    plan = tmp_path / "work" / "schedule.json"
    assert plan.exists() == (at > QUICK["occupancy_warmup_steps"] + TIMED)
    again = job(tmp_path, settings(**QUICK), poses=scene, stop=stop)
    train.run(again)
    said = report(again)
    assert 0.95 * QUICK["time_budget"] <= said["seconds"] <= QUICK["time_budget"]  # what was spent before counts
    assert repeated(scene, said) == tensors_of(again)


PACES: dict[str, Callable[[int], float]] = {
    "dearer": lambda step: 0.2 + step / 2000,
    "cheaper": lambda step: 0.5 - step / 2000,
    "sudden": lambda step: 0.3 if step < 200 else 0.2,
}


@pytest.mark.parametrize("pace", PACES.values(), ids=PACES)
@pytest.mark.parametrize("stops", [(), (40, 90, 300)])
def test_steps_that_change_their_pace_end_on_time(tmp_path: Path, pace: Callable[[int], float], stops: tuple[int, ...]) -> None:
    """Also where attempts are interrupted and go on from a checkpoint ten steps before."""
    times, step, spent, began = [0.0], 0, 0.0, 0.0
    given = settings(occupancy_warmup_steps=10, time_budget=120.0)
    budget = training_budget(given, tmp_path, 0.0, lambda: times[-1])
    before_stop: set[int] = set()
    while step < budget.schedule.iterations:
        if step in stops and step not in before_stop:
            before_stop.add(step)
            step -= 10
            spent, began = spent + times[-1] - began, times[-1]
            budget = training_budget(given, tmp_path, spent, lambda: times[-1])
        before = budget.schedule.fraction(step + 1)
        times.append(times[-1] + pace(step))
        step += 1
        budget.after(step)
        assert budget.schedule.fraction(step) == pytest.approx(before, abs=1e-6)  # a revision changes nothing that has been done
    assert 0.97 * 120 < spent + times[-1] - began <= 120 * 1.005
    assert budget.schedule.fraction(step) == pytest.approx(1.0)
