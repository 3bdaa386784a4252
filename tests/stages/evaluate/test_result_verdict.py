"""The verdict on a result: the grade that people who look at the pictures give, worse figures never a better one, and each problem with what to do."""

import random
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from efficientnerf.asset.camera_paths import pose_on_sphere
from stages.artifacts import EvaluateOutputs, MeshOutputs, PosesOutputs, SplatsOutputs
from stages.evaluate.sparse_points import COLOURS, FARTHER, NEARER
from stages.io.capture import SparsePoints
from stages.io.scene import load, save, save_points
from stages.reports import CameraProblem, CameraVerdict
from stages.verdict.grades import GRADES
from stages.verdict.result import ResultVerdict, verdict_on_result
from tests.fakes import WHITE, BallField
from tests.stages.evaluate.balls import TREE, figures_of, job_in, make_scene, measure, problems_of, settings, verdict_of
from tests.stages.evaluate.results import BLURRED, WORSE, a_result, worse
from workflows import asset

# Of photographs of real captures at 800 px: PSNR of the mean colour, and of the photographs after blurs; then the asset's, fitted, and what it is.
CAPTURES = {
    "still life": (16.2, [32.0, 28.8, 25.7, 23.7, 22.0, 20.4], 29.4, "good"),
    "banana": (19.3, [27.0, 25.4, 24.1, 23.3, 22.4, 21.5], 27.0, "good"),
    "fern, leaves": (12.1, [25.0, 22.2, 20.2, 18.3, 16.6, 15.2], 24.6, "good"),
    "chair": (14.7, [29.0, 26.2, 24.0, 22.1, 20.4, 18.9], 34.9, "good"),
    "gamepad, repaired": (10.5, [29.0, 25.7, 22.5, 19.8, 17.2, 14.7], 22.9, "good"),
    "bonsai, subject masked": (13.2, [27.0, 24.4, 22.1, 20.1, 18.4, 17.0], 18.9, "poor"),
    "still life, 30 s of training": (16.2, [32.0, 28.8, 25.7, 23.7, 22.0, 20.4], 22.7, "poor"),
    "gamepad, subject masked": (10.5, [29.0, 25.7, 22.5, 19.8, 17.2, 14.7], 11.5, "failed"),
    "fog before a bare wall": (20.0, [36.0, 34.0, 32.0, 30.0, 28.0, 26.0], 25.0, "poor"),
}


@pytest.mark.parametrize("name", CAPTURES)
def test_captures_are_graded_as_who_looks_at_them_does(name: str) -> None:
    mean_colour, blurred, psnr, grade = CAPTURES[name]
    assert verdict_on_result(a_result(psnr, mean_colour=mean_colour, blurred=blurred)).grade == grade


@pytest.mark.parametrize(
    ("detail", "blurred", "grade"),
    [(30.0, BLURRED, "usable"), (23.0, BLURRED, "poor"), (60.0, [50.0, 44.0, 40.0, 38.0, 36.0, 35.0], "poor")],
    ids=["right", "gone", "none in the photographs"],
)
def test_shading_that_differs_is_not_poor_where_the_detail_is_right(detail: float, blurred: list[float], grade: str) -> None:
    """As of an object on a plain table; of a bare wall behind fog there is no detail that could be right."""
    found = a_result(22.7, detail=detail)
    for view in found["views"]:
        view["trivial"]["blurred_detail"] = blurred
    verdict = verdict_on_result(found)
    assert verdict.grade == grade
    assert ("shading" in verdict.problems[0].cause) == (grade == "usable")


SETTINGS = {f"{stage.name}.{name}" for stage in asset.STAGES for name in stage.settings.__dataclass_fields__}
PICTURES = {
    f"evaluate/{EvaluateOutputs.strip_worst}", f"evaluate/{EvaluateOutputs.contact_sheet}", f"evaluate/{EvaluateOutputs.sparse_points}",
    f"mesh/{MeshOutputs.check}", f"splats/{SplatsOutputs.preview}", f"poses/{PosesOutputs.cameras}",
}  # fmt: skip


def check(found: ResultVerdict) -> None:
    """What holds of every verdict."""
    assert found.grade == max([each.grade for each in found.problems], key=GRADES.index, default="good")
    assert [each.grade for each in found.problems] == sorted((each.grade for each in found.problems), key=GRADES.index, reverse=True)
    for each in found.problems:
        assert all(text.strip() for text in (each.what, each.sentence, each.cause, each.remedy)), each
        assert each.picture in PICTURES
        assert set(re.findall(r"\b(?:poses|train|bake|mesh|splats|evaluate)\.[a-z_]+\b(?!\.)", each.remedy)) <= SETTINGS, each.remedy
    assert found.document()["summary"].startswith(f"Result: {found.grade}")


@pytest.mark.parametrize("seed", range(4))
def test_worse_figures_never_give_a_better_grade(seed: int) -> None:
    rng = random.Random(seed)
    found, grades = a_result(rng.uniform(10.0, 30.0)), []
    for _ in range(40):
        verdict = verdict_on_result(found, CameraVerdict("usable", "", [CameraProblem("S.", "R.", "usable")]))
        check(verdict)
        grades.append(GRADES.index(verdict.grade))
        found = worse(found, rng.choice(list(WORSE)))
    assert grades == sorted(grades)


def test_worse_cameras_never_give_a_better_grade() -> None:
    for psnr in (29.4, 24.0, 22.0, 12.0):
        grades = [GRADES.index(verdict_on_result(a_result(psnr), CameraVerdict(grade, "", [CameraProblem("S.", "R.", grade)])).grade) for grade in GRADES]
        assert grades == sorted(grades)


@pytest.mark.parametrize("name", sorted(WORSE))
def test_each_thing_that_is_bad_is_found_and_is_no_failure_by_itself(name: str) -> None:
    needed = {"one view": 4, "asset": 20, "points farther": 4, "points nearer": 4, "mesh": 5, "splats": 5}.get(name, 3)
    alone = {"holes": ["holes' error"], "floaters": ["floaters' error"], "holes' error": ["holes"], "floaters' error": ["floaters"]}.get(name, [])
    found = verdict_on_result(worse(a_result(), *[name] * needed, *alone))
    check(found)
    assert found.problems
    assert found.grade == ("failed" if name == "asset" else found.grade)
    assert name == "asset" or found.grade != "failed"


def test_a_mesh_that_would_be_graded_lower_than_the_asset_lowers_the_grade() -> None:
    """The gamepad's mesh as measured, dented and ragged: 22.2 dB for the asset, 20.2 for the mesh."""
    mean_colour, blurred, *_ = CAPTURES["gamepad, repaired"]
    found = a_result(22.2, mean_colour=mean_colour, blurred=blurred)
    for view in found["views"]:
        view["mesh"]["psnr"] = 22.0
    assert verdict_on_result(found).grade == "good"
    for view in found["views"]:
        view["mesh"]["psnr"] = 20.2
    verdict = verdict_on_result(found)
    assert (verdict.grade, [each.what for each in verdict.problems]) == ("usable", ["mesh"])
    for view in found["views"]:
        view["asset"].update(psnr=20.2, psnr_colour_fitted=20.2)
    assert [each.what for each in verdict_on_result(found).problems] == ["pictures"]


CAUSES: dict[str, tuple[Any, str]] = {
    "short": (lambda found: found.update(refinement={"steps": 2, "usual_steps": 827}), "bake.refine_steps"),
    "baking": (lambda found: found["gap"].update(psnr=-3.0), "bake.max_mib"),
    "by heart": (lambda found: found["train"].update(psnr=33.0), "Take more photographs"),
    "masked": (lambda found: found["sparse_points"].update(subject_farther=0.9), "train.min_views"),
    "empty": (lambda found: found["sparse_points"].update(farther=0.8, agreeing=0.15), "poses.masks=ignore"),
    "fog": (lambda found: found["sparse_points"].update(nearer=0.8, agreeing=0.15), "longer training"),
    "nothing else": (lambda found: None, "--budget"),
}


@pytest.mark.parametrize("name", CAUSES)
def test_a_cause_that_is_seen_is_named_with_its_own_remedy(name: str) -> None:
    found = a_result(22.0)
    CAUSES[name][0](found)
    (pictures,) = (each for each in verdict_on_result(found).problems if each.what == "pictures")
    assert CAUSES[name][1] in pictures.remedy


def with_points(poses: Path, xyz: np.ndarray, observers: int = 3) -> None:
    """Sparse points that the first views of a scene see."""
    count = len(xyz)
    tracks = tuple(tuple(range(observers)) for _ in range(count))
    save_points(SparsePoints(xyz, np.zeros((count, 3), np.uint8), np.full(count, 0.3), tracks), poses)
    save(replace(load(poses), points=True), poses)


def on_the_ball(count: int = 80, radius: float = TREE.radius) -> np.ndarray:
    """Points of its side that the first three cameras of `make_scene` see."""
    towards = pose_on_sphere((0.0, 0.0, 0.0), 1.0, 30.0, 20.0)[:3, 3]
    spread = towards + 0.25 * np.random.default_rng(0).normal(size=(count, 3))
    return radius * spread / np.linalg.norm(spread, axis=1, keepdims=True)


@pytest.mark.parametrize(("off", "reported"), [(0.004, False), (0.02, False), (0.11, True)])
def test_holes_that_nobody_sees_are_not_reported(off: float, reported: bool) -> None:
    """off: root mean square by which the colours in them are worse than the network's."""
    found = {**a_result(), "holes": 0.035, "holes_excess_error": 0.035 * off**2}
    assert ("holes" in {problem.what for problem in verdict_on_result(found).problems}) == reported


@pytest.mark.parametrize(("share", "first"), [(0.4, "pictures"), (0.6, "holes")])
def test_holes_come_first_where_they_hold_most_of_the_error(share: float, first: str) -> None:
    mean_colour, blurred, *_ = CAPTURES["still life"]
    found = a_result(24.5, mean_colour=mean_colour, blurred=blurred)
    error = np.mean([10 ** (-view["asset"]["psnr"] / 10) for view in found["views"]])
    verdict = verdict_on_result({**found, "holes": 0.036, "holes_excess_error": share * error})
    check(verdict)
    assert {"pictures", "holes"} <= {problem.what for problem in verdict.problems}
    assert verdict.problems[0].what == first


def test_an_asset_that_is_right_is_good_and_agrees_with_its_points(tmp_path: Path) -> None:
    poses = make_scene(tmp_path / "poses", "tttr")
    with_points(poses, on_the_ball())
    job = job_in(tmp_path, poses)
    measure(TREE, lambda: BallField(TREE, background=WHITE), job)
    found = figures_of(job)
    assert found["sparse_points"]["points"] > 200
    assert found["sparse_points"]["agreeing"] > 0.95
    assert verdict_of(job)["grade"] == "good"
    assert found["train"]["views"] == 1
    assert found["train"]["psnr"] > 50


@pytest.mark.parametrize(("radius", "which"), [(0.35, "farther"), (0.85, "nearer")])
def test_an_asset_at_another_depth_is_found_by_its_points(tmp_path: Path, radius: float, which: str) -> None:
    poses = make_scene(tmp_path / "poses", "ttt")
    with_points(poses, on_the_ball())
    job = job_in(tmp_path, poses)
    measure(replace(TREE, radius=radius), lambda: BallField(TREE, background=WHITE), job)
    assert figures_of(job)["sparse_points"][which] > 0.6
    assert ("missing" if which == "farther" else "depth") in problems_of(job)
    picture = np.asarray(Image.open(job.out / EvaluateOutputs.sparse_points))
    colour = COLOURS[FARTHER if which == "farther" else NEARER]
    assert (picture == colour).all(-1).sum() > 20


@pytest.mark.parametrize("observers", [0, 2])
def test_points_that_are_not_reliable_say_nothing(tmp_path: Path, observers: int) -> None:
    poses = make_scene(tmp_path / "poses", "ttt")
    with_points(poses, on_the_ball(radius=0.2), observers)
    job = job_in(tmp_path, poses)
    measure(TREE, lambda: BallField(TREE, background=WHITE), job)
    assert figures_of(job)["sparse_points"] is None
    assert verdict_of(job)["grade"] == "good"
    assert not (job.out / EvaluateOutputs.sparse_points).exists()


def test_what_the_asset_loses_makes_it_fail(tmp_path: Path) -> None:
    """An empty asset, of a network that is right: the pictures are white. And one in a strong fog of its own mean colour."""
    poses = make_scene(tmp_path / "poses", "tttr")
    with_points(poses, on_the_ball())
    job = job_in(tmp_path, poses, settings(strips="on"))
    measure(replace(TREE, sigma=1e-7), lambda: BallField(TREE, background=WHITE), job)
    found = verdict_of(job)
    assert found["grade"] == "failed"
    assert {"pictures", "missing", "gap", "holes"} <= problems_of(job)
    assert all((job.out.parent / job.out.name / Path(each["picture"]).name).is_file() for each in found["problems"] if each["picture"].startswith("evaluate/"))
