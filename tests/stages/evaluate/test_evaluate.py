"""The evaluate stage on a ball with a closed form: the right views, the right figures, over the right background, the same after a stop."""

import hashlib
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from efficientnerf.asset.camera_paths import pose_on_sphere
from efficientnerf.evaluation.metrics import psnr, ssim
from efficientnerf.geometry.cameras import Camera
from pipeline.errors import Interrupted
from stages.evaluate.asset import over_field
from stages.evaluate.views import bounded_stride, stride_for, subsample_camera
from stages.io.scene import View
from tests.fakes import WHITE, BallField
from tests.stages.evaluate.balls import HEIGHT, TREE, WIDTH, figures_of, job_in, make_scene, measure, settings
from tests.stages.spoilers import SPOILERS


def test_a_perfect_asset_is_as_good_as_eight_bits_allow(tmp_path: Path) -> None:
    job = job_in(tmp_path, make_scene(tmp_path / "poses", "rtrtrt"))
    field = BallField(TREE, background=WHITE, noise=0.02)
    measure(TREE, lambda: field, job)
    metrics = figures_of(job)
    assert metrics["split"] == "test"
    assert [view["name"] for view in metrics["views"]] == ["v1.png", "v3.png", "v5.png"]
    assert metrics["asset"]["psnr"] > 50
    assert metrics["asset"]["ssim"] > 0.999
    # noise of +-0.02, halved at most where clipping to white takes one side: between 10 log10(1 / 0.02^2) and 3 dB more
    assert 33.9 < metrics["network"]["psnr"] < 37.0
    assert metrics["network"]["psnr_in_box"] == pytest.approx(33.98, abs=0.1)
    assert metrics["network"]["psnr"] == pytest.approx(np.mean([view["network"]["psnr"] for view in metrics["views"]]))
    assert metrics["network"]["scale"] == 1.0
    assert metrics["asset"]["views"] == metrics["network"]["views"] == 3
    assert sorted(path.name for path in job.out.iterdir()) == ["contact_sheet.png", "metrics.json", "verdict.json"]
    assert field.calls == [(f"v{k}.png", WIDTH, HEIGHT) for k in (1, 3, 5)]


def test_figures_are_those_of_the_metrics(tmp_path: Path) -> None:
    poses = make_scene(tmp_path / "poses", "rt")
    worse = replace(TREE, radius=0.5)
    job = job_in(tmp_path, poses)
    measure(worse, lambda: BallField(worse, background=WHITE), job)
    with Image.open(poses / "images" / "v1.png") as image:
        pixels = np.asarray(image) / np.float32(255)
    truth = pixels[..., :3] * pixels[..., 3:] + 1 - pixels[..., 3:]
    camera = Camera("v1.png", WIDTH, HEIGHT, "SIMPLE_PINHOLE", (70.0, WIDTH / 2, HEIGHT / 2), pose_on_sphere((0.0, 0.0, 0.0), 3.0, 30.0, 20.0))
    image = worse.render(camera, background=WHITE).colour
    found = figures_of(job)["views"][0]["asset"]
    assert found["psnr"] == pytest.approx(psnr(image, truth), abs=1e-4)
    assert found["ssim"] == pytest.approx(ssim(image, truth), abs=1e-5)
    assert found["psnr_in_box"] == pytest.approx(psnr(image, truth, pixels[..., 3] > 0), abs=1e-4)
    assert found["psnr_in_box"] < found["psnr"] < 30


@pytest.mark.parametrize(("splits", "expected", "warned"), [("rrv", "val", False), ("rr", "train", True), ("rvt", "test", False)])
def test_val_stands_in_for_test_and_train_for_both_with_a_warning(tmp_path: Path, splits: str, expected: str, warned: bool) -> None:
    events: list[dict[str, Any]] = []
    job = job_in(tmp_path, make_scene(tmp_path / "poses", splits), report=events.append)
    measure(TREE, lambda: BallField(TREE, background=WHITE), job)
    assert figures_of(job)["split"] == expected
    assert any("training views" in event["text"] for event in events if event["event"] == "warning") == warned


@pytest.mark.parametrize("stride", [1, 2])
def test_an_asset_lies_between_what_the_field_shows_before_and_behind_its_box(stride: int) -> None:
    camera = Camera("a", WIDTH, HEIGHT, "SIMPLE_PINHOLE", (70.0, WIDTH / 2, HEIGHT / 2), pose_on_sphere((0.0, 0.0, 0.0), 3.0, 0.0, 20.0))
    view, field = View("a", None, "test", camera, camera, 0.0, 1.0), BallField(TREE)
    fog, seen = np.float32([0.2, 0.1, 0.0, 0.4]), field.render(subsample_camera(camera, stride))
    seen = replace(seen, before=np.broadcast_to(fog, (*seen.opacity.shape, 4)))
    expected = fog[:3] + 0.6 * field.render(camera).colour
    assert psnr(over_field(TREE.render, view, seen, stride), expected) > 40, "surroundings are smooth: upsampling them loses little"


def test_what_masks_hide_does_not_count(tmp_path: Path) -> None:
    job = job_in(tmp_path, make_scene(tmp_path / "poses", "tt", masked=True), settings(field_views=1))
    measure(TREE, lambda: BallField(TREE, background=WHITE), job)
    metrics = figures_of(job)
    assert metrics["asset"]["psnr"] > 45
    assert metrics["asset"]["ssim"] > 0.99
    assert metrics["network"]["psnr"] > 45


@pytest.mark.parametrize("moment", [1, 4])
def test_a_stop_and_going_on_gives_the_same_bytes_and_measures_no_view_twice(tmp_path: Path, moment: int) -> None:
    poses = make_scene(tmp_path / "poses", "tttt")
    whole = job_in(tmp_path / "whole", poses, settings(field_views=2))
    measure(TREE, lambda: BallField(TREE, background=WHITE), whole)
    asked, first, second = iter(range(100)), BallField(TREE, background=WHITE), BallField(TREE, background=WHITE)
    stopped = job_in(tmp_path, poses, settings(field_views=2), "first", stop=lambda: 2 if next(asked) >= moment else None)
    with pytest.raises(Interrupted):
        measure(TREE, lambda: first, stopped)
    job = job_in(tmp_path, poses, settings(field_views=2), "second")
    measure(TREE, lambda: second, job)
    for name in ("metrics.json", "verdict.json", "contact_sheet.png"):
        assert hashlib.sha256((job.out / name).read_bytes()).digest() == hashlib.sha256((whole.out / name).read_bytes()).digest()
    assert len(first.calls) + len(second.calls) == 2


@pytest.mark.parametrize(("pattern", "how"), [("view_*", "cut"), ("view_*", "link"), ("picture_*", "zero")])
def test_every_scratch_file_of_an_evaluation_may_be_damaged(tmp_path: Path, pattern: str, how: str) -> None:
    poses = make_scene(tmp_path / "poses", "tttt")
    whole = job_in(tmp_path / "whole", poses, settings(field_views=2))
    measure(TREE, lambda: BallField(TREE, background=WHITE), whole)
    shutil.copytree(whole.work, tmp_path / "work")
    for path in sorted(whole.work.glob(pattern)):
        SPOILERS[how](tmp_path / "work" / path.name)
    events: list[dict[str, Any]] = []
    job = job_in(tmp_path, poses, settings(field_views=2), report=events.append)
    measure(TREE, lambda: BallField(TREE, background=WHITE), job)
    for name in ("metrics.json", "contact_sheet.png"):
        assert (job.out / name).read_bytes() == (whole.out / name).read_bytes()
    warned = [event["text"].partition(" ")[0] for event in events if event["event"] == "warning" and ".json" in event["text"].partition(" ")[0]]
    assert warned == ["view_00000.json" if pattern == "view_*" else "view_00001.json"]


def test_stride_for_bounds_the_pixels() -> None:
    view = View("a", None, "test", Camera("a", 100, 100, "SIMPLE_PINHOLE", (1.0, 50.0, 50.0), np.eye(4)), None, 0.0, 1.0)
    assert stride_for([view] * 4, 40_000) == 1
    assert stride_for([view] * 4, 10_000) == 2
    assert stride_for([view] * 4, 9_999) == 3
    assert stride_for([], 1) == 1
    assert stride_for([view], 1) == bounded_stride([view], 10**6) == min(view.camera.width, view.camera.height), "each view keeps a pixel"
