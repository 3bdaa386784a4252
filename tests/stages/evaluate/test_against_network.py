"""The asset against its network on a ball with a closed form: gap, holes, floaters, fitted colours."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from efficientnerf.evaluation.metrics import psnr, ssim
from stages.evaluate.views import ground_truth, subsample
from stages.io.scene import load
from tests.fakes import WHITE, BallField, BallTree
from tests.stages.evaluate.balls import TREE, figures_of, job_in, make_scene, measure, problems_of, settings


def test_an_asset_like_its_network_has_no_gap_no_holes_and_no_more_floaters(tmp_path: Path) -> None:
    job = job_in(tmp_path, make_scene(tmp_path / "poses", "ttt"), settings(field_views=2, field_image_scale=0.5))
    measure(TREE, lambda: BallField(TREE, background=WHITE), job)
    found = figures_of(job)
    assert found["gap"]["views"] == 2
    assert found["gap"]["psnr"] == pytest.approx(0.0, abs=1e-6)
    assert found["gap"]["ssim"] == pytest.approx(0.0, abs=1e-3)
    assert found["holes"] == 0.0
    assert found["floaters"] == pytest.approx(found["network"]["floaters"])
    assert 0 <= found["floaters"] < 0.1, "half of the light is gone 0.017 behind the front, before which the margin is 0.05"


def test_the_gap_is_that_of_the_same_pixels(tmp_path: Path) -> None:
    poses = make_scene(tmp_path / "poses", "t")
    worse, job = replace(TREE, radius=0.5), job_in(tmp_path, poses, settings(field_image_scale=0.34))
    measure(worse, lambda: BallField(TREE, background=WHITE, noise=0.03), job)
    found = figures_of(job)
    camera = load(poses).views[0].camera
    truth = ground_truth(poses, load(poses).views[0], WHITE).subsampled(3).colour
    image = subsample(worse.render(camera, background=WHITE).colour, 3)
    assert found["gap"]["psnr"] == pytest.approx(psnr(image.clip(0, 1), truth) - found["network"]["psnr"], abs=1e-4)
    assert found["gap"]["ssim"] == pytest.approx(ssim(image.clip(0, 1), truth) - found["network"]["ssim"], abs=1e-5)
    assert found["views"][0]["gap"] == {name: found["gap"][name] for name in ("psnr", "ssim", "psnr_colour_fitted")}


def test_holes_are_what_the_network_has_and_the_asset_has_not(tmp_path: Path) -> None:
    poses = make_scene(tmp_path / "poses", "t")
    smaller, job = replace(TREE, radius=0.45), job_in(tmp_path, poses)
    measure(smaller, lambda: BallField(TREE, background=WHITE), job)
    camera = load(poses).views[0].camera
    share = ((smaller.render(camera).opacity < 0.5) & (TREE.render(camera).opacity > 0.95)).mean()
    assert figures_of(job)["holes"] == pytest.approx(share)
    assert share > 0.03
    larger = job_in(tmp_path / "larger", poses)
    measure(TREE, lambda: BallField(smaller, background=WHITE), larger)
    assert figures_of(larger)["holes"] == 0.0


def test_floaters_are_what_hangs_before_the_surface(tmp_path: Path) -> None:
    poses = make_scene(tmp_path / "poses", "tt")
    fog, job = replace(TREE, radius=0.9, sigma=0.5), job_in(tmp_path, poses)
    measure(fog, lambda: BallField(TREE, background=WHITE), job)
    found = figures_of(job)
    assert found["floaters"] > 0.5, "fog round the ball: most of it before its surface, or where it has none"
    assert found["network"]["floaters"] < 0.3
    assert all(view["floaters"] > 0.5 for view in found["views"])
    nothing = job_in(tmp_path / "nothing", poses)
    measure(replace(TREE, sigma=1e-7), lambda: BallField(TREE, background=WHITE), nothing)
    assert figures_of(nothing)["floaters"] is None
    assert figures_of(nothing)["holes"] > 0.1
    assert {"gap", "holes"} <= problems_of(nothing)


def test_photographs_decide_who_is_wrong_where_asset_and_network_differ(tmp_path: Path) -> None:
    poses = make_scene(tmp_path / "poses", "tt")

    def told(name: str, asset: BallTree, network: BallTree) -> tuple[dict[str, Any], set[str]]:
        job = job_in(tmp_path / name, poses)
        measure(asset, lambda: BallField(network, background=WHITE), job)
        return figures_of(job), problems_of(job)

    larger, smaller = replace(TREE, radius=0.7), replace(TREE, radius=0.45)
    found, problems = told("network too large", TREE, larger)
    assert found["holes"] > 0.03
    assert found["holes_excess_error"] < -0.001
    assert "holes" not in problems
    found, problems = told("network too small", TREE, smaller)
    assert found["floaters"] - found["network"]["floaters"] > 0.02
    assert found["floaters_excess_error"] < -0.001
    assert "floaters" not in problems
    found, problems = told("asset too small", smaller, TREE)
    assert found["holes_excess_error"] > 0.001
    assert "holes" in problems
    found, problems = told("asset too large", larger, TREE)
    assert found["floaters_excess_error"] > 0.001
    assert "floaters" in problems
