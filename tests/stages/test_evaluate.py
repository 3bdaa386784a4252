"""The evaluate stage on a ball with a closed form: the right views, the right figures, over the right background, the same after a stop."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from efficientnerf.asset.cascades import cascade_tree, cascades_of, subset, voxel_cascades
from efficientnerf.asset.rendering import Rendering, render_reference
from efficientnerf.asset.tree import NerfTree
from efficientnerf.evaluation.metrics import psnr, ssim
from efficientnerf.evaluation.surfaces import opacity_nearer
from efficientnerf.geometry.cameras import Camera, Similarity, rays
from efficientnerf.geometry.spaces import Box
from efficientnerf.rendering.field_renderer import FieldRendering, SampleCounts
from pipeline.errors import Interrupted
from pipeline.stage import Job
from stages.evaluate import EvaluateSettings, evaluate
from stages.evaluation.asset import EvaluatedAsset, evaluated
from stages.evaluation.views import evenly_spaced, ground_truth, stride_for, subsample, subsample_camera, upsample
from stages.figures.plots import to_uint8
from stages.framing.camera_paths import pose_on_sphere
from stages.io.exporters.frames import frame_from_rendering
from stages.io.png import write_png
from stages.io.scene import Orbit, Scene, View, load, save
from stages.scratch import note
from tests.efficientnerf.trees import random_cascades
from tests.fakes import WHITE, BallField, BallTree
from tests.stages.spoilers import SPOILERS

TREE = BallTree()
WIDTH, HEIGHT = 60, 44


def make_scene(folder: Path, splits: str, *, background: tuple[float, float, float] | None = WHITE, masked: bool = False) -> Path:
    """A poses artifact that photographs TREE: RGBA on a constant background, RGB with the field's surroundings without. One letter of splits per view."""
    (folder / "images").mkdir(parents=True)
    views = []
    for k, letter in enumerate(splits):
        pose = pose_on_sphere((0.0, 0.0, 0.0), 3.0, 30.0 * k, 20.0)
        camera = Camera(f"v{k}.png", WIDTH, HEIGHT, "SIMPLE_PINHOLE", (70.0, WIDTH / 2, HEIGHT / 2), pose)
        if background is None:
            frame = to_uint8(BallField(TREE).render(camera).colour)
        else:
            seen = TREE.render(camera)
            frame = frame_from_rendering(seen.colour, seen.opacity, None)
        mask = None
        if masked:
            # The photograph is spoilt where the mask says so.
            frame = frame.copy()
            frame[:10, :, :3] = 255 - frame[:10, :, :3]
            mask = f"images/mask{k}.png"
            used = np.full((HEIGHT, WIDTH), 255, np.uint8)
            used[:10] = 0
            Image.fromarray(used).save(folder / mask)
        write_png(frame, folder / "images" / f"v{k}.png")
        split = {"r": "train", "v": "val", "t": "test"}[letter]
        views.append(View(f"images/v{k}.png", mask, split, camera, camera, 1.0, 5.0))
    scene = Scene("ball", tuple(views), np.array([[-1.0] * 3, [1.0] * 3]), background, Similarity.identity(), Orbit((0.0, 0.0, 0.0), 3.0, 20.0, False, 0.0))
    save(scene, folder)
    return folder


def settings(**more: Any) -> EvaluateSettings:
    return EvaluateSettings(**{"strips": "off", "captured_path_frames": "off", **more})


def job_in(folder: Path, poses: Path, chosen: EvaluateSettings | None = None, out: str = "out", **more: Any) -> Job:
    return Job(settings=chosen or settings(), out=folder / out, work=folder / "work", inputs={"poses": poses, "train": folder / "no refined cameras"}, **more)


def measure(tree: BallTree, load_field: Callable[[], Any], job: Job, **more: Any) -> None:
    evaluate(tree.evaluated(**more), tree, load_field, job)


def reference_image(tree: NerfTree, camera: Camera, *, background: tuple[float, float, float] | None = None, supersample: int = 1) -> Rendering:
    """The image of a tree by the reference render: over its environment, or over a background in its place."""
    seen = replace(tree, environment=None) if background is not None else tree
    colour, opacity = (part.numpy() for part in render_reference(seen, *(torch.from_numpy(a) for a in rays(camera))))
    behind = np.zeros(3) if background is None else np.asarray(background)
    size = (camera.height, camera.width)
    flat = np.zeros(size, np.float32)
    return Rendering((colour + (1 - opacity[:, None]) * behind).reshape(*size, 3).astype(np.float32), opacity.reshape(size).astype(np.float32), flat, flat)


def whole_asset(tree: NerfTree) -> EvaluatedAsset:
    """As `evaluated`, by the reference render."""
    made = evaluated(tree)
    return replace(made, render=partial(reference_image, tree), inner=partial(reference_image, cascade_tree(tree, 0)))


class ReferenceField:
    """A field that is a tree: split by its cascade 0."""

    def __init__(self, tree: NerfTree) -> None:
        self.tree = tree
        self.calls: list[str] = []
        self.boxes: list[tuple[Any, Any]] = []

    def render(self, camera: Camera, progress: Any = None, *, box: Any = None, reach: Any = None, limits: Any = None) -> FieldRendering:
        tree, size = self.tree, (camera.height, camera.width)
        bounds = [cascade.bounds(tree.brick) for cascade in cascades_of(tree)]
        self.calls.append(camera.name)
        self.boxes += [(box, bounds[0]), (reach, bounds[-1])]
        origins, directions = rays(camera)
        inner, all_of_it = reference_image(cascade_tree(tree, 0), camera), reference_image(tree, camera)
        enter = (1 - 1e-9) * Box(bounds[0]).intersect(torch.from_numpy(origins), torch.from_numpy(directions))[0].clamp(min=0)
        before = opacity_nearer(subset(tree, voxel_cascades(tree) > 0), origins, directions, enter.numpy()).reshape(size)
        assert before.max() < 1e-6, "these cameras stand in cascade 0"
        passing = np.maximum(1 - inner.opacity, 1e-6)[..., None]
        behind = ((all_of_it.colour - inner.colour) / passing).astype(np.float32)
        nearer = None if limits is None else np.zeros(size, np.float32)
        depth = np.full(size, np.inf, np.float32)
        nothing = np.zeros((*size, 4), np.float32)
        return FieldRendering(all_of_it.colour, all_of_it.opacity, depth, nothing, behind, inner.opacity, SampleCounts(), all_of_it.opacity, nearer)


def photographed(tree: NerfTree, folder: Path, count: int) -> Path:
    """A poses artifact of photographs from the middle of a tree outwards."""
    (folder / "images").mkdir(parents=True)
    middle, views = (tree.bounds_min + tree.bounds_max) / 2, []
    for k in range(count):
        pose = pose_on_sphere(tuple(middle), 0.1, 360.0 * k / count, 10.0)
        camera = Camera(f"v{k}.png", 24, 18, "SIMPLE_PINHOLE", (16.0, 12.0, 9.0), pose)
        write_png(to_uint8(reference_image(tree, camera).colour), folder / "images" / f"v{k}.png")
        views.append(View(f"images/v{k}.png", None, "test", camera, camera, 0.01, 50.0))
    save(Scene("tree", tuple(views), np.array([[-1.0] * 3, [1.0] * 3]), None, Similarity.identity(), Orbit((0.0, 0.0, 0.0), 3.0, 20.0, False, 0.0)), folder)
    return folder


def figures_of(job: Job) -> dict[str, Any]:
    return json.loads((job.out / "metrics.json").read_text())


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
    assert sorted(path.name for path in job.out.iterdir()) == ["contact_sheet.png", "metrics.json"]
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


def test_the_network_is_bounded_in_views_and_scale_and_the_asset_is_not(tmp_path: Path) -> None:
    job = job_in(tmp_path, make_scene(tmp_path / "poses", "t" * 6), settings(field_views=2, field_image_scale=0.5))
    field = BallField(TREE, background=WHITE)
    measure(TREE, lambda: field, job)
    metrics = figures_of(job)
    assert [view["network"] is not None for view in metrics["views"]] == [False, True, False, False, True, False]
    assert (metrics["network"]["views"], metrics["network"]["scale"], metrics["asset"]["views"]) == (2, 0.5, 6)
    assert {call[1:] for call in field.calls} == {(30, 22)}
    assert metrics["views"][1]["network"]["psnr"] > 50, "subsampling takes nothing from a perfect field"
    assert metrics["views"][1]["asset"]["width"] == WIDTH


@pytest.mark.parametrize(("splits", "expected", "warned"), [("rrv", "val", False), ("rr", "train", True), ("rvt", "test", False)])
def test_val_stands_in_for_test_and_train_for_both_with_a_warning(tmp_path: Path, splits: str, expected: str, warned: bool) -> None:
    events: list[dict[str, Any]] = []
    job = job_in(tmp_path, make_scene(tmp_path / "poses", splits), report=events.append)
    measure(TREE, lambda: BallField(TREE, background=WHITE), job)
    assert figures_of(job)["split"] == expected
    assert any("training saw" in event["text"] for event in events if event["event"] == "warning") == warned


def test_on_photographs_the_asset_lies_over_the_networks_background(tmp_path: Path) -> None:
    job = job_in(tmp_path, make_scene(tmp_path / "poses", "tttt", background=None), settings(field_views=2, field_background_rays=WIDTH * HEIGHT // 2))
    field = BallField(TREE)
    measure(TREE, lambda: field, job)
    metrics = figures_of(job)
    assert metrics["asset"]["psnr"] > 40, "surroundings are smooth: upsampling them loses little"
    assert metrics["asset"]["psnr_in_box"] > 45
    assert metrics["asset"]["background_scale"] == {"network_views": 1.0, "other_views": 0.5}
    assert [width for _, width, _ in field.calls] == [30, WIDTH, 30, WIDTH]
    assert metrics["network"]["psnr_in_box"] > 45
    assert metrics["network"]["psnr"] > 50


def test_an_asset_that_shows_nothing_is_bad_in_its_box_even_on_a_good_background(tmp_path: Path) -> None:
    job = job_in(tmp_path, make_scene(tmp_path / "poses", "t", background=None))
    measure(replace(TREE, sigma=1e-6), lambda: BallField(TREE), job)
    metrics = figures_of(job)
    assert metrics["asset"]["psnr_in_box"] < 20
    assert metrics["asset"]["psnr"] < 25
    assert metrics["network"]["psnr_in_box"] > 45


def test_light_before_the_box_covers_the_asset(tmp_path: Path) -> None:
    class Fog(BallField):
        def render(self, camera: Camera, progress: Any = None, **more: Any) -> Any:
            seen = super().render(camera, **more)
            before = np.broadcast_to(np.float32([0.2, 0.1, 0.0, 0.4]), (*seen.opacity.shape, 4)).copy()
            return replace(seen, before=before, colour=before[..., :3] + 0.6 * seen.colour)

    poses = make_scene(tmp_path / "poses", "t", background=None)
    camera = Camera("v0.png", WIDTH, HEIGHT, "SIMPLE_PINHOLE", (70.0, WIDTH / 2, HEIGHT / 2), pose_on_sphere((0.0, 0.0, 0.0), 3.0, 0.0, 20.0))
    write_png(to_uint8(Fog(TREE).render(camera).colour), poses / "images" / "v0.png")
    job = job_in(tmp_path, poses)
    measure(TREE, lambda: Fog(TREE), job)
    assert figures_of(job)["asset"]["psnr"] > 50
    assert figures_of(job)["network"]["psnr"] > 50


@pytest.mark.parametrize("background", [WHITE, None])
def test_what_masks_hide_does_not_count(tmp_path: Path, background: tuple[float, float, float] | None) -> None:
    job = job_in(tmp_path, make_scene(tmp_path / "poses", "tt", background=background, masked=True), settings(field_views=1))
    measure(TREE, lambda: BallField(TREE, background=background), job)
    metrics = figures_of(job)
    assert metrics["asset"]["psnr"] > 45
    assert metrics["asset"]["ssim"] > 0.99
    assert metrics["network"]["psnr"] > 45


def test_a_mask_that_hides_everything_leaves_the_view_out_of_the_means(tmp_path: Path) -> None:
    poses = make_scene(tmp_path / "poses", "tt", masked=True)
    Image.fromarray(np.zeros((HEIGHT, WIDTH), np.uint8)).save(poses / "images" / "mask0.png")
    events: list[dict[str, Any]] = []
    job = job_in(tmp_path, poses, report=events.append)
    measure(TREE, lambda: BallField(TREE, background=WHITE), job)
    metrics = figures_of(job)
    assert metrics["views"][0]["asset"]["psnr"] is None
    assert metrics["asset"]["psnr"] == metrics["views"][1]["asset"]["psnr"]
    assert any("v0.png" in event["text"] for event in events if event["event"] == "warning")


def test_a_field_of_nans_counts_as_black_with_a_warning(tmp_path: Path) -> None:
    class Broken(BallField):
        def render(self, camera: Camera, progress: Any = None, **more: Any) -> Any:
            return replace(super().render(camera, **more), colour=np.full((camera.height, camera.width, 3), np.nan, np.float32))

    events: list[dict[str, Any]] = []
    job = job_in(tmp_path, make_scene(tmp_path / "poses", "t"), report=events.append)
    measure(TREE, lambda: Broken(TREE, background=WHITE), job)
    assert 0 < figures_of(job)["network"]["psnr"] < 10
    assert any("not finite" in event["text"] for event in events if event["event"] == "warning")


@pytest.mark.parametrize("moment", [1, 2, 4])
def test_a_stop_and_going_on_gives_the_same_bytes_and_measures_no_view_twice(tmp_path: Path, moment: int) -> None:
    poses = make_scene(tmp_path / "poses", "tttt", background=None)
    whole = job_in(tmp_path / "whole", poses, settings(field_views=2))
    measure(TREE, lambda: BallField(TREE), whole)
    asked, first, second = iter(range(100)), BallField(TREE), BallField(TREE)
    stopped = job_in(tmp_path, poses, settings(field_views=2), "first", stop=lambda: 2 if next(asked) >= moment else None)
    with pytest.raises(Interrupted):
        measure(TREE, lambda: first, stopped)
    job = job_in(tmp_path, poses, settings(field_views=2), "second")
    measure(TREE, lambda: second, job)
    for name in ("metrics.json", "contact_sheet.png"):
        assert hashlib.sha256((job.out / name).read_bytes()).digest() == hashlib.sha256((whole.out / name).read_bytes()).digest()
    finished = len(list((tmp_path / "work").glob("view_*.json"))) - len(second.calls)
    assert finished == moment // 2


@pytest.mark.parametrize("how", SPOILERS)
@pytest.mark.parametrize("pattern", ["view_*", "picture_*"])
def test_every_scratch_file_of_an_evaluation_may_be_damaged(tmp_path: Path, pattern: str, how: str) -> None:
    poses = make_scene(tmp_path / "poses", "tttt", background=None)
    whole = job_in(tmp_path / "whole", poses, settings(field_views=2))
    measure(TREE, lambda: BallField(TREE), whole)
    shutil.copytree(whole.work, tmp_path / "work")
    for path in sorted(whole.work.glob(pattern)):
        SPOILERS[how](tmp_path / "work" / path.name)
    events: list[dict[str, Any]] = []
    job = job_in(tmp_path, poses, settings(field_views=2), report=events.append)
    measure(TREE, lambda: BallField(TREE), job)
    for name in ("metrics.json", "contact_sheet.png"):
        assert (job.out / name).read_bytes() == (whole.out / name).read_bytes()
    warned = [event["text"].partition(" ")[0] for event in events if event["event"] == "warning"]
    assert warned == ["view_00000.json" if pattern == "view_*" else "view_00001.json"]


@pytest.mark.parametrize(
    "value", [None, {}, {"name": "v0.png", "network": None, "asset": {}}, {"name": "v0.png", "network": None, "asset": None}, {"name": "v9.png"}]
)
def test_odd_metrics_in_scratch_are_measured_again(tmp_path: Path, value: Any) -> None:
    poses = make_scene(tmp_path / "poses", "tt")
    whole = job_in(tmp_path / "whole", poses, settings(field_views=1))
    measure(TREE, lambda: BallField(TREE, background=WHITE), whole)
    for k in range(2):
        (tmp_path / "work").mkdir(exist_ok=True)
        note(tmp_path / "work" / f"view_{k:05d}.json", value)
    job = job_in(tmp_path, poses, settings(field_views=1))
    measure(TREE, lambda: BallField(TREE, background=WHITE), job)
    assert (job.out / "metrics.json").read_bytes() == (whole.out / "metrics.json").read_bytes()


@pytest.mark.parametrize("background", [WHITE, None])
def test_an_asset_like_its_network_has_no_gap_no_holes_and_no_more_floaters(tmp_path: Path, background: tuple[float, float, float] | None) -> None:
    job = job_in(tmp_path, make_scene(tmp_path / "poses", "ttt", background=background), settings(field_views=2, field_image_scale=0.5))
    measure(TREE, lambda: BallField(TREE, background=background), job)
    found = figures_of(job)
    assert found["gap"]["views"] == 2
    assert found["gap"]["psnr"] == pytest.approx(0.0, abs=0.5 if background is None else 1e-6), "surroundings are upsampled"
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
    events: list[dict[str, Any]] = []
    nothing = job_in(tmp_path / "nothing", poses, report=events.append)
    measure(replace(TREE, sigma=1e-7), lambda: BallField(TREE, background=WHITE), nothing)
    assert figures_of(nothing)["floaters"] is None
    assert figures_of(nothing)["holes"] > 0.1
    warnings = " ".join(event["text"] for event in events if event["event"] == "warning")
    assert "dB behind its network" in warnings
    assert "the asset has holes" in warnings


def test_a_colour_cast_is_fitted_away(tmp_path: Path) -> None:
    class Warm(BallTree):
        def render(self, camera: Camera, **more: Any) -> Any:
            seen = super().render(camera, **more)
            return replace(seen, colour=seen.colour * np.float32([0.95, 0.9, 0.8]))

    job = job_in(tmp_path, make_scene(tmp_path / "poses", "t"))
    measure(Warm(), lambda: BallField(TREE, background=WHITE), job)
    found = figures_of(job)
    assert found["asset"]["psnr"] < 25
    assert found["asset"]["psnr_colour_fitted"] > 50
    assert found["network"]["psnr_colour_fitted"] == pytest.approx(found["network"]["psnr"], abs=3.0)


def test_strips_show_worst_median_and_best_at_full_size(tmp_path: Path) -> None:
    poses = make_scene(tmp_path / "poses", "tttt", background=None)
    worse, job = replace(TREE, centre=(0.1, 0.0, 0.0)), job_in(tmp_path, poses, settings(strips="on", field_views=1, field_image_scale=0.5))
    field = BallField(TREE)
    measure(worse, lambda: field, job)
    found = figures_of(job)
    ranked = sorted(found["views"], key=lambda view: view["asset"]["psnr"])
    assert [(strip["which"], strip["view"]) for strip in found["strips"]] == [("worst", ranked[0]["name"]), ("median", ranked[2]["name"]),
                                                                              ("best", ranked[3]["name"])]  # fmt: skip
    assert [call[1:] for call in field.calls[-3:]] == [(WIDTH, HEIGHT)] * 3
    for strip in found["strips"]:
        with Image.open(job.out / strip["file"]) as image:
            assert image.width >= 3 * WIDTH
            picture = np.asarray(image)
        assert strip["network"]["psnr"] > 45 > strip["asset"]["psnr"]
        view = next(view for view in load(poses).views if view.name == strip["view"])
        with Image.open(poses / view.image) as image:
            photograph = np.asarray(image)
        rows, columns = np.nonzero((picture == photograph[0, 0]).all(-1))
        assert any(np.array_equal(picture[y : y + HEIGHT, x : x + WIDTH], photograph) for y, x in zip(rows, columns, strict=True)), "pixel for pixel"


@pytest.mark.parametrize(("splits", "expected"), [("t", ["median"]), ("tt", ["worst", "best"])])
def test_few_views_give_few_strips(tmp_path: Path, splits: str, expected: list[str]) -> None:
    job = job_in(tmp_path, make_scene(tmp_path / "poses", splits), settings(strips="on"))
    measure(TREE, lambda: BallField(TREE, background=WHITE), job)
    assert [strip["which"] for strip in figures_of(job)["strips"]] == expected
    assert sorted(path.name for path in job.out.glob("strip_*")) == sorted(f"strip_{which}.png" for which in expected)


def test_strips_of_large_photographs_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("stages.evaluation.strips.STRIP_RAYS", WIDTH * HEIGHT // 4)
    job, field = job_in(tmp_path, make_scene(tmp_path / "poses", "t"), settings(strips="on")), BallField(TREE, background=WHITE)
    measure(TREE, lambda: field, job)
    assert field.calls[-1][1:] == (WIDTH // 2, HEIGHT // 2)
    assert figures_of(job)["strips"][0]["network"]["psnr"] > 50


def test_the_captured_path_is_a_video_of_the_asset(tmp_path: Path) -> None:
    import av

    job = job_in(tmp_path, make_scene(tmp_path / "poses", "rrtr"), settings(captured_path_frames=7))
    measure(TREE, lambda: BallField(TREE, background=WHITE), job)
    with av.open(str(job.out / "captured_path.mp4")) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(frames) == 7
    assert frames[0].shape == (352, 480, 3)
    first = TREE.render(replace(load(tmp_path / "poses").views[0].camera, width=480, height=352, params=(560.0, 240.0, 176.0)), background=WHITE).colour
    assert np.abs(frames[0] / 255.0 - first).mean() < 0.02, "it begins at the first photograph"
    assert sorted(path.name for path in job.out.iterdir()) == ["captured_path.mp4", "contact_sheet.png", "metrics.json"]


@pytest.mark.parametrize("pattern", ["strip_*", "captured/frame_*"])
@pytest.mark.parametrize("how", SPOILERS)
def test_damaged_strips_and_frames_are_made_again(tmp_path: Path, how: str, pattern: str) -> None:
    poses, chosen = make_scene(tmp_path / "poses", "tt"), settings(strips="on", captured_path_frames=2)
    whole = job_in(tmp_path / "whole", poses, chosen)
    measure(TREE, lambda: BallField(TREE, background=WHITE), whole)
    shutil.copytree(whole.work, tmp_path / "work")
    for path in sorted(whole.work.glob(pattern)):
        SPOILERS[how](tmp_path / "work" / path.relative_to(whole.work))
    job = job_in(tmp_path, poses, chosen)
    measure(TREE, lambda: BallField(TREE, background=WHITE), job)
    names = [path.name for path in sorted(whole.out.iterdir())]
    assert len(names) == 5
    for name in names:
        assert (job.out / name).read_bytes() == (whole.out / name).read_bytes()


def test_a_whole_scene_is_rendered_by_itself_and_over_the_network_too(tmp_path: Path) -> None:
    tree = random_cascades(5)
    poses = photographed(tree, tmp_path / "poses", 3)
    field = ReferenceField(tree)
    job = job_in(tmp_path, poses, settings(field_views=2, strips="on"))
    evaluate(whole_asset(tree), TREE, lambda: field, job)
    found = figures_of(job)
    assert found["asset"]["psnr"] > 50
    assert found["asset"]["views"] == 3
    assert "background_scale" not in found["asset"]
    assert found["gap"]["psnr"] == pytest.approx(0.0, abs=1e-3)
    assert found["holes"] == 0.0
    assert found["asset_with_network_background"]["views"] == 2
    assert found["asset_with_network_background"]["psnr"] > 50, "the field's surroundings are the asset's"
    assert [view["asset_with_network_background"] is None for view in found["views"]] == [view["network"] is None for view in found["views"]]
    assert len(field.calls) == 2 + 3, "what the asset shows by itself needs no field"
    assert all(np.array_equal(box, bounds) for box, bounds in field.boxes)


def test_a_whole_scene_without_its_surroundings_shows_it(tmp_path: Path) -> None:
    tree = random_cascades(5)
    poses = photographed(tree, tmp_path / "poses", 2)
    bare = subset(tree, voxel_cascades(tree) == 0)
    job = job_in(tmp_path, poses)
    evaluate(whole_asset(bare), TREE, lambda: ReferenceField(tree), job)
    found = figures_of(job)
    assert found["gap"]["psnr"] < -5
    assert found["holes"] > 0.05
    assert found["asset_with_network_background"]["psnr"] > 50, "the field stands in for what is lost, which is why that figure is not enough"


def test_the_field_is_not_loaded_where_nothing_needs_it(tmp_path: Path) -> None:
    poses = make_scene(tmp_path / "poses", "tt")
    measure(TREE, lambda: BallField(TREE, background=WHITE), job_in(tmp_path, poses))

    def refuse() -> Any:
        raise AssertionError("loaded")

    measure(TREE, refuse, job_in(tmp_path, poses, out="again"))


def test_spread_is_even_and_complete() -> None:
    assert evenly_spaced(10, None) == evenly_spaced(10, 12) == list(range(10))
    assert evenly_spaced(10, 2) == [2, 7]
    assert evenly_spaced(9, 1) == [4]
    for count in range(1, 30):
        for wanted in range(1, count):
            chosen = evenly_spaced(count, wanted)
            assert len(set(chosen)) == wanted
            assert 0 <= chosen[0] <= chosen[-1] < count


def test_stride_for_bounds_the_pixels() -> None:
    view = View("a", None, "test", Camera("a", 100, 100, "SIMPLE_PINHOLE", (1.0, 50.0, 50.0), np.eye(4)), None, 0.0, 1.0)
    assert stride_for([view] * 4, 40_000) == 1
    assert stride_for([view] * 4, 10_000) == 2
    assert stride_for([view] * 4, 9_999) == 3
    assert stride_for([], 1) == 1


@pytest.mark.parametrize("stride", [1, 2, 3, 4])
@pytest.mark.parametrize("model", [("SIMPLE_RADIAL", (70.0, 31.0, 20.0, 0.1)), ("OPENCV_FISHEYE", (70.0, 72.0, 31.0, 20.0, 0.1, 0.01, 0.0, 0.0))])
def test_a_subsampled_camera_has_the_rays_of_the_pixels_that_are_kept(stride: int, model: tuple[str, tuple[float, ...]]) -> None:
    camera = Camera("a", 61, 44, *model, pose_on_sphere((0.0, 0.0, 0.0), 3.0, 10.0, 20.0))
    small = subsample_camera(camera, stride)
    expected = subsample(rays(camera)[1].reshape(44, 61, 3), stride)
    np.testing.assert_allclose(rays(small)[1].reshape(small.height, small.width, 3), expected, atol=1e-12)


@pytest.mark.parametrize("stride", [1, 2, 3, 4])
def test_upsampling_gives_back_what_was_kept_and_straight_lines_between(stride: int) -> None:
    y, x = np.mgrid[0:40, 0:50].astype(np.float32)
    ramp = np.stack([x, y, x + 2 * y, np.ones_like(x)], -1)
    again = upsample(subsample(ramp, stride), stride, 50, 40)
    np.testing.assert_allclose(subsample(again, stride), subsample(ramp, stride), atol=1e-4)
    inner = slice(stride, -stride)
    np.testing.assert_allclose(again[inner, inner], ramp[inner, inner], atol=0.2)  # OpenCV knows 32 places between two pixels
