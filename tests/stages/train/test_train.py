"""The train stage: the same bytes whatever happened on the way."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.errors import CorruptArtifact, Interrupted, UsageError
from pipeline.stage import Job
from stages.artifacts import TrainOutputs
from stages.io import refined_cameras
from stages.io import scene as scenes
from stages.io.capture import SparsePoints
from stages.io.field_file import load_exposure, load_renderer
from stages.io.png import write_png
from stages.io.refined_cameras import load_scene
from stages.train import run as train
from stages.train.averaged import as_taken
from stages.train.data import depth_range, pixels_of, sparse_depth_of
from tests.efficientnerf.balls import settings
from tests.stages.balls import StopAt, job, poses

QUICK = {"iterations": 13, "checkpoint_every": 4, "sample_batch_size": 1024, "occupancy_warmup_steps": 6, "preview_every": 5}


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return poses(tmp_path_factory.mktemp("train") / "poses")


def run(made: Job) -> str:
    """The digest of the field."""
    train.run(made)
    return hashlib.sha256((made.out / TrainOutputs.field).read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def undisturbed(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    return run(job(tmp_path_factory.mktemp("undisturbed"), settings(**QUICK), poses=scene))


def checkpoints(made: Job) -> list[str]:
    return sorted(path.name for path in made.work.glob("checkpoint_*"))


@pytest.mark.parametrize(("name", "idle", "weight"), [("plain_loss_weight", 0.0, 0.01), ("highlight_loss_weight", 1.0, 0.1)])
def test_a_loss_without_effect_is_reported(name: str, idle: float, weight: float, scene: Path, tmp_path: Path) -> None:
    """The ball has alpha and a constant background."""
    for value in (idle, weight):
        events: list[dict[str, Any]] = []
        train.run(job(tmp_path / str(value), settings(**{**QUICK, "iterations": 3, name: value}), poses=scene, events=events))
        assert any(f"train.{name}" in str(event.get("text")) for event in events) == (value == weight)


def test_it_leaves_a_field_a_log_a_curve_and_previews(scene: Path, tmp_path: Path, undisturbed: str) -> None:
    events: list[dict[str, Any]] = []
    made = job(tmp_path, settings(**QUICK), poses=scene, events=events)
    assert run(made) == undisturbed  # twice the same
    assert sorted(path.relative_to(made.out).as_posix() for path in made.out.rglob("*") if path.is_file()) == [
        "curve.png", TrainOutputs.field, "log.jsonl", "previews/preview_000005.png", "previews/preview_000010.png", "report.json",
    ]  # fmt: skip
    lines = [json.loads(line) for line in (made.out / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [5, 10, 13]
    assert [line["preview_psnr"] is None for line in lines] == [False, False, True]
    assert all(line["step_seconds"] > 0 for line in lines)
    assert all(0 < line["valid"] <= line["tried"] and 0 < line["occupied"] <= 1 for line in lines)
    assert checkpoints(made) == ["checkpoint_00000008.safetensors", "checkpoint_00000012.safetensors"]
    assert events[-1]["event"] == "progress"
    assert events[-1]["done"] == events[-1]["total"] == 13
    assert {"loss", "psnr", "preview_psnr", "preview_ssim", "samples_per_s", "occupied", "left"} <= events[-1].keys()
    assert events[-1]["samples_per_s"] > 0
    assert events[-1]["left"] == 0
    assert (made.work / "curve.png").exists()  # drawn at each preview, for those who wait
    assert np.isfinite(load_renderer(made.out).model.voxels.values.numpy()).all()


@pytest.mark.parametrize("calls", [(1,), (2, 9), (13,)])
def test_a_stopped_run_goes_on_to_the_same_bytes(scene: Path, tmp_path: Path, undisturbed: str, calls: tuple[int, ...]) -> None:
    stop = StopAt(*calls)
    for _ in calls:
        with pytest.raises(Interrupted):
            run(job(tmp_path, settings(**QUICK), poses=scene, stop=stop))
        assert not (tmp_path / "out" / TrainOutputs.field).exists()
        assert 1 <= len(checkpoints(job(tmp_path, None))) <= 2
    events: list[dict[str, Any]] = []
    assert run(job(tmp_path, settings(**QUICK), poses=scene, stop=stop, events=events)) == undisturbed
    assert any("resuming training from step" in event.get("text", "") for event in events)
    lines = [json.loads(line)["step"] for line in (tmp_path / "out" / "log.jsonl").read_text().splitlines()]
    assert lines == [5, 10, 13]


def test_a_damaged_checkpoint_gives_way_to_the_one_before(scene: Path, tmp_path: Path, undisturbed: str) -> None:
    with pytest.raises(Interrupted):
        run(job(tmp_path, settings(**QUICK), poses=scene, stop=StopAt(9)))
    newest = sorted((tmp_path / "work").glob("checkpoint_*"))[-1]
    assert newest.name == "checkpoint_00000009.safetensors"
    data = bytearray(newest.read_bytes())
    data[len(data) // 2] ^= 4
    newest.write_bytes(data)
    events: list[dict[str, Any]] = []
    assert run(job(tmp_path, settings(**QUICK), poses=scene, events=events)) == undisturbed
    assert any(event["event"] == "warning" and "checkpoint_00000009" in event["text"] for event in events)
    assert any("resuming training from step 8" in event.get("text", "") for event in events)


def test_rays_to_the_table_come_with_those_to_sparse_points(tmp_path: Path) -> None:
    """Half as many, from all views that see it; within the hull of the points on it."""
    folder = poses(tmp_path / "poses", points=True)
    s = scenes.load(folder)
    views = [view for view in s.views if view.camera.centre[2] > -0.5]
    s = replace(s, views=tuple(views))
    scenes.save(s, folder)
    number = len(views)
    xyz = np.column_stack([np.random.default_rng(0).uniform(-0.8, 0.8, (60, 2)), np.full(60, -0.6)])
    scenes.save_points(SparsePoints(xyz, np.zeros((60, 3), np.uint8), np.zeros(60), (tuple(range(number)),) * 60), folder)
    found = sparse_depth_of(folder, s)
    assert found is not None
    ends = (found.origins + found.distance[:, None] * found.directions)[found.on_support]
    assert 0.2 * len(found) < len(ends) <= len(found) / 3
    np.testing.assert_allclose(ends[:, 2], xyz[0, 2], atol=1e-5)
    assert np.abs(ends[:, :2]).max() < 0.8


def test_points_in_a_camera_or_behind_it_give_no_sparse_depth(tmp_path: Path) -> None:
    folder = poses(tmp_path / "poses", points=True)
    s = scenes.load(folder)
    cameras = [view.camera for view in s.views]
    xyz = np.array([[0.0, 0, 0], cameras[0].centre, cameras[1].centre - cameras[1].forward, [0.1, 0, 0]])
    seen = ((0, 1, 2), (0, 1, 2), (1, 3, 4), (0, 1))
    points = SparsePoints(xyz, np.zeros((4, 3), np.uint8), np.zeros(4), seen)

    def rays(points: SparsePoints) -> tuple[list[tuple[int, int]], Any]:
        """(point, camera) of each ray, found again from its ends."""
        scenes.save_points(points, folder)
        found_rays = sparse_depth_of(folder, s)
        if found_rays is None:
            return [], None
        np.testing.assert_allclose(np.linalg.norm(found_rays.directions, axis=1), 1, atol=1e-6)
        ends = found_rays.origins + found_rays.distance[:, None] * found_rays.directions
        found = [(int(np.nanargmin(np.linalg.norm(points.xyz - end, axis=1))), int(np.argmin(np.linalg.norm(centres - origin, axis=1))))
                 for origin, end in zip(found_rays.origins, ends, strict=True)]  # fmt: skip
        return sorted(found), found_rays

    centres = np.array([camera.centre for camera in cameras])
    before = {(n, view) for n, views in enumerate(seen) for view in views if len(views) > 2 and (xyz[n] - centres[view]) @ cameras[view].forward > 1e-9}
    assert {(0, 0), (0, 1), (0, 2)} <= before
    assert not {(1, 0), (2, 1)} & before
    half = len(before)
    found, every = rays(points)
    assert len(found) == 2 * half  # as many from cameras as from between them
    real = every.origins[:half]
    apart = np.linalg.norm(real[:, None] - centres, axis=-1)
    assert sorted(zip([n for n, _ in sorted(before)], apart.argmin(axis=1), strict=True)) == sorted(before)
    np.testing.assert_allclose(apart.min(axis=1), 0, atol=1e-6)
    for (point, view), origin in zip(sorted(before), every.origins[half:], strict=True):
        others = [centres[other] for n, other in before if n == point and other != view]
        nearest = min(others, key=lambda other: float(np.linalg.norm(other - centres[view])), default=centres[view])
        way, done = nearest - centres[view], origin - centres[view]
        np.testing.assert_allclose(np.cross(way, done), 0, atol=1e-5)
        assert -1e-6 <= way @ done <= way @ way + 1e-6
    assert np.abs(every.origins[half:] - real).max() > 0.01
    assert not every.on_support.any()
    only = SparsePoints(np.repeat(cameras[0].centre[None], 1, axis=0), points.rgb[:1], points.error[:1], ((0, 0, 0),))
    assert rays(only) == ([], None)


SPOILED: list[Callable[[dict[str, Any]], object]] = [
    lambda d: d.update(format=2),
    lambda d: d["cameras"].update({"images/none.png": next(iter(d["cameras"].values()))}),
    lambda d: next(iter(d["cameras"].values())).update(width=9),
    lambda d: next(iter(d["cameras"].values())).update(world_from_camera=np.eye(4)[::-1].tolist()),
    lambda d: next(iter(d["cameras"].values())).update(params=[-1.0, 8.0, 8.0]),
    lambda d: next(iter(d["cameras"].values())).update(params=[1.0]),
    lambda d: d.pop("cameras"),
]


def test_other_cameras_than_training_wrote_are_refused(tmp_path: Path) -> None:
    scene = poses(tmp_path / "poses", photographs=True)
    views = scenes.views_of(scenes.load(scene), "train")
    path = TrainOutputs(tmp_path).cameras
    refined_cameras.write(views, [view.camera for view in views], path)
    written = path.read_text()
    load_scene(scene, tmp_path)
    for spoil in SPOILED:
        document = json.loads(written)
        spoil(document)
        path.write_text(json.dumps(document))
        with pytest.raises(CorruptArtifact, match=path.name):
            load_scene(scene, tmp_path)


def test_exposures_are_saved(tmp_path: Path) -> None:
    scene = poses(tmp_path / "poses", photographs=True)
    made = job(tmp_path / "a", settings(exposure="on", iterations=12, preview_every="off"), poses=scene)
    train.run(made)
    found = load_exposure(made.out)
    assert found is not None
    names, learned = found
    assert names == [view.image for view in scenes.load(scene).views]  # the test view is the last
    gains = learned.log_gains().numpy()
    assert gains.mean(axis=0) == pytest.approx(0, abs=1e-6)
    assert np.abs(gains[:7]).max() > 1e-4
    assert np.abs(gains[7]).max() < 1e-6  # held back: as exposed on average
    report = json.loads((made.out / "report.json").read_text())
    assert report["exposure"]["least_stops"] <= 0 <= report["exposure"]["most_stops"]
    assert load_renderer(made.out).model.settings.exposure == "on"
    s, image = scenes.load(scene), np.full((16, 16, 3), 0.5, np.float32)
    taken = as_taken(made.out, s)
    assert taken is not None
    seen = [taken(view, image, 1) for view in s.views]
    assert np.ptp([one[8, 8] for one in seen[:7]]) > 1e-5  # the exposure of each
    assert min(one.min() for one in seen[:7]) <= seen[7].min() <= seen[7].max() <= max(one.max() for one in seen[:7])
    assert as_taken(tmp_path, s) is None


def test_planes_that_miss_the_scene_are_refused(scene: Path) -> None:
    """The views have 1 to 5 of the training frame before them, which is 2 to 10 in the capture's units."""
    s = scenes.load(scene)
    pixels = pixels_of(scene, scenes.views_of(s, "train"))

    def told(near: float, far: float) -> list[str]:
        found: list[str] = []
        assert depth_range(s, pixels, settings(near_plane=near, far_plane=far), found.append) == (near / 2, far / 2)
        assert (pixels.near == near / 2).all()
        assert (pixels.far == far / 2).all()
        return found

    for near, far in ((10.0, 12.0), (0.1, 2.0)):
        with pytest.raises(UsageError, match=rf"near_plane .* {near:g} to {far:g} .* 2 to 10"):
            told(near, far)
    assert told(2.0, 10.0) == told(0.0, 100.0) == told(2.5, 9.0) == []
    for near, far in ((5.0, 10.0), (1.0, 6.0)):
        assert [f"are {near:g} to {far:g} " in text and "miss a part of it" in text for text in told(near, far)] == [True]


@pytest.fixture
def early_checks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the training views, after few steps."""
    from efficientnerf.training.view_checks import checks

    monkeypatch.setattr(checks, "LOWEST", (40, 50, 60, 70))


SWAPPED = QUICK | {"iterations": 140, "checkpoint_every": 1000, "preview_every": "off", "sample_batch_size": 4096, "occupancy_warmup_steps": 20}


def swapped(folder: Path) -> tuple[Path, list[str]]:
    """A scene in which one photograph is of something else; the image of it."""
    scene = poses(folder, count=20)
    rng = np.random.default_rng(0)
    picture = 255 * rng.integers(0, 2, (4, 4, 4), np.uint8).repeat(4, axis=0).repeat(4, axis=1)
    picture[..., 3] = 255
    write_png(picture, scene / "images" / "v05.png")
    return scene, ["images/v05.png"]


def test_a_view_that_shows_something_else_is_left_out_here_and_after(tmp_path: Path, early_checks: None) -> None:
    scene, wrong = swapped(tmp_path / "poses")
    made = job(tmp_path / "a", settings(**SWAPPED), poses=scene)
    digest = run(made)
    assert json.loads((made.out / TrainOutputs.cameras).read_text())["left_out"] == wrong
    found = json.loads((made.out / "report.json").read_text())["wrong_views"]
    assert [(each["image"], each["outcome"]) for each in found] == [("v05.png", "left out")]
    assert len(found[0]["witnesses"]) >= 2
    assert (made.out / TrainOutputs.wrong_views).is_file()
    later = load_scene(scene, made.out)
    assert [view.image for view in scenes.views_of(later, "train")] == [f"images/v{n:02}.png" for n in range(19) if n != 5]
    again, stop = tmp_path / "stopped", StopAt(55)
    with pytest.raises(Interrupted):
        run(job(again, settings(**SWAPPED), poses=scene, stop=stop))
    assert run(job(again, settings(**SWAPPED), poses=scene, stop=stop)) == digest
    for name in (TrainOutputs.cameras, TrainOutputs.wrong_views):
        assert (again / "out" / name).read_bytes() == (made.out / name).read_bytes()


def test_without_wrong_views_the_checks_change_nothing(tmp_path: Path, early_checks: None) -> None:
    scene = poses(tmp_path / "poses", count=20)
    on, off = (job(tmp_path / choice, settings(**SWAPPED, wrong_views=choice), poses=scene) for choice in ("auto", "off"))
    run(on)
    run(off)
    models = [load_renderer(each.out).model for each in (on, off)]
    assert all(np.array_equal(a, b) for a, b in zip(*[[p.detach().numpy() for p in m.fine.parameters()] for m in models], strict=True))
    assert not (on.out / TrainOutputs.cameras).exists()
    assert not (on.out / TrainOutputs.wrong_views).exists()
    assert json.loads((on.out / "report.json").read_text())["wrong_views"] == []
