"""Whether anything is learned, and what follows where nothing is: a training that fails by construction is reported, rescued, and repeatable to the byte."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipeline.errors import Interrupted
from stages.artifacts import TrainOutputs
from stages.evaluate.trivial import blurred
from stages.io import scene as scenes
from stages.io.refined_cameras import load_scene
from stages.io.scene import View
from stages.train import choices as training_choices
from stages.train import run as train
from stages.train.checks import early_check, second_chances
from stages.train.checks.early_check import HeldOutView, judge
from stages.train.choices import TrainingChoices
from tests.efficientnerf import balls
from tests.efficientnerf.balls import settings
from tests.stages.balls import StopAt, job, poses

LOOKED, STEPS = 40, 80
QUICK = {"iterations": STEPS, "checkpoint_every": 15}


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(early_check, "MIN_STEP", LOOKED)
    monkeypatch.setattr(second_chances, "SMALL", settings(iterations=LOOKED))


def ball(folder: Path, change: Callable[[View, Path], View] = lambda view, folder: view, **options: Any) -> Path:
    """A ball that is learned in `LOOKED` steps, its views changed."""
    made = poses(folder, count=10, **options)
    s = scenes.load(made)
    scenes.save(replace(s, views=tuple(change(view, made) for view in s.views)), made)
    return made


def behind(view: View, folder: Path) -> View:
    """With its near plane behind the subject."""
    return replace(view, near=4.2)


def inverted(view: View, folder: Path) -> View:
    """With a mask that leaves out the subject and nothing else."""
    mask = view.image.replace(".png", "_mask.png")
    Image.fromarray(np.where(np.array(Image.open(folder / view.image))[..., 3] > 0, 0, 255).astype(np.uint8)).save(folder / mask)
    return replace(view, mask=mask)


def digest(folder: Path) -> str:
    """Of what later stages read."""
    outputs = TrainOutputs(folder / "out")
    return hashlib.sha256(outputs.field.read_bytes() + outputs.choices.read_bytes()).hexdigest()


def report(folder: Path) -> dict[str, Any]:
    return dict(json.loads(TrainOutputs(folder / "out").report.read_text()))


def held_out(colour: np.ndarray, counted: np.ndarray | None = None) -> HeldOutView:
    height, width = colour.shape[:2]
    camera = replace(balls.cameras(1)[0], width=width, height=height)
    return HeldOutView(camera, colour.astype(np.float32), np.ones((height, width), bool) if counted is None else counted)


def photograph(rng: np.random.Generator, side: int = 40) -> np.ndarray:
    """Patches of colours, with fine texture."""
    patches = np.kron(rng.random((5, 5, 3)), np.ones((side // 5, side // 5, 1)))
    return np.asarray(0.8 * patches + 0.2 * rng.random((side, side, 3)))


@pytest.mark.parametrize("seed", range(2))
def test_no_plain_colour_is_progress_and_the_photograph_is(seed: int) -> None:
    rng = np.random.default_rng(seed)
    views = [held_out(photograph(rng)) for _ in range(3)]

    def result(render: Callable[[HeldOutView], np.ndarray]) -> early_check.EarlyResult:
        renders = iter(views)
        found = judge(views, lambda camera: render(next(renders)), 7)
        assert found is not None
        return found

    plain = result(lambda view: np.broadcast_to(rng.random(3), view.colour.shape))
    assert plain.progress <= 1e-6
    assert not plain.learning
    assert not result(lambda view: np.zeros_like(view.colour)).learning
    assert not result(lambda view: rng.random(view.colour.shape)).learning
    diverged = result(lambda view: np.full_like(view.colour, np.nan))
    assert not diverged.learning
    assert np.isfinite(diverged.progress)
    assert not result(lambda view: views[0].colour if view is not views[0] else views[1].colour).learning
    good = result(lambda view: view.colour)
    assert good.learning
    assert good.progress > 1
    assert (good.views, good.step) == (3, 7)
    assert result(lambda view: 0.6 * view.colour).learning  # an exposure of its own
    assert result(lambda view: view.colour if view is not views[0] else np.zeros_like(view.colour)).learning  # one of three has a wrong camera
    assert result(lambda view: blurred(view.colour, early_check.BLUR * 40)).progress == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("background", [(1.0, 1.0, 1.0), (0.0, 0.0, 0.0)])
def test_an_empty_field_has_learned_nothing_whatever_the_background(tmp_path: Path, background: tuple[float, float, float]) -> None:
    folder = poses(tmp_path / "poses", side=64, background=background)
    s = scenes.load(folder)
    views = early_check.held_out_views(folder, s)
    assert [view.camera.name for view in views] == [view.camera.name for view in s.views if view.split == "test"]
    assert 0.05 < np.mean([view.counted.mean() for view in views]) < 0.5
    found = judge(views, lambda camera: np.broadcast_to(np.array(background), (camera.height, camera.width, 3)), 1)
    assert not found.learning


def test_a_training_that_learns_is_left_alone(tmp_path: Path) -> None:
    events: list[dict[str, Any]] = []
    made = job(tmp_path, settings(**QUICK), poses=ball(tmp_path / "poses", background=(0.0, 0.0, 0.0)), events=events)
    train.run(made)
    assert [event for event in events if event["event"] == "warning"] == []
    found = report(tmp_path)
    assert [check["learning"] for check in found["early_check"]] == [True]
    assert (found["early_check"][0]["step"], found["second_chances"], found["chosen"]) == (LOOKED, [], None)
    assert not TrainOutputs(made.out).choices.exists()
    assert training_choices.load(made.out) == TrainingChoices()


@pytest.mark.parametrize(
    ("change", "chosen", "choices"),
    [(behind, "near planes off", TrainingChoices(near="off")), (inverted, "masks ignored", TrainingChoices(masks=False))],
)
def test_what_a_prior_deletes_comes_back_without_it(tmp_path: Path, change: Callable[[View, Path], View], chosen: str, choices: TrainingChoices) -> None:
    events: list[dict[str, Any]] = []
    made = job(tmp_path, settings(**QUICK), poses=ball(tmp_path / "poses", change), events=events)
    train.run(made)
    warned = [event["early_check"] for event in events if event["event"] == "warning" and "early_check" in event]
    assert [check["step"] for check in warned] == [LOOKED]
    found = report(tmp_path)
    assert found["chosen"] == chosen
    assert made.facts["early_check"]["chosen"] == chosen
    assert [check["learning"] for check in found["early_check"]] == [False, True]
    assert {second_chances.AS_STATED, chosen} <= {trial["name"] for trial in found["second_chances"]}
    assert training_choices.load(made.out) == choices
    stated, used = scenes.load(made.inputs["poses"]), load_scene(made.inputs["poses"], made.out)
    assert choices.scene(stated).views[0].near == used.views[0].near
    assert [view.mask for view in used.views] == [view.mask if choices.masks else None for view in stated.views]


def test_a_training_that_is_stopped_anywhere_ends_with_the_same_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = ball(tmp_path / "poses", behind)
    train.run(job(tmp_path / "undisturbed", settings(**QUICK), poses=folder))
    expected = digest(tmp_path / "undisturbed")
    # In the training that fails, in two trials, and in the training that follows.
    stop, count = StopAt(20, LOOKED + 10, 2 * LOOKED + 5, 4 * LOOKED + 30), 0
    trained: list[str] = []
    real = second_chances._train
    monkeypatch.setattr(second_chances, "_train", lambda *arguments: [real(*arguments), trained.append(arguments[-1])][0])
    while True:
        try:
            train.run(job(tmp_path / "stopped", settings(**QUICK), poses=folder, stop=stop))
            break
        except Interrupted:
            count += 1
    assert count == len(stop.calls)
    assert digest(tmp_path / "stopped") == expected
    assert len(trained) == len(set(trained)) == len(report(tmp_path / "stopped")["second_chances"])  # none that was finished is done again
    assert report(tmp_path / "stopped")["second_chances"] == report(tmp_path / "undisturbed")["second_chances"]


def test_candidates_are_what_would_change_anything(tmp_path: Path) -> None:
    photographs = scenes.load(poses(tmp_path / "photographs", photographs=True))
    names = second_chances.candidates(photographs, settings())
    assert list(names) == [second_chances.AS_STATED, "near planes off", "min_views off", "all of these off", "exposure"]
    assert names["all of these off"] == TrainingChoices(near="off", min_views=False)
    stated = settings(min_views="off", exposure="on")
    assert list(second_chances.candidates(photographs, stated)) == [second_chances.AS_STATED, "near planes off"]
    odd = replace(photographs, views=(*photographs.views[:-2], replace(photographs.views[-2], near=4.0), photographs.views[-1]))
    assert second_chances.candidates(odd, settings())["near planes at most their median"].scene(odd).views[-2].near == photographs.views[-2].near
    own = TrainingChoices(near="off", masks=False, min_views=False, exposure=True).settings(settings())
    assert (own.min_views, own.exposure) == ("off", "on")
