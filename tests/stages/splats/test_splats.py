"""The stage `splats` on a real asset file that holds a ball, before its photographs and without them."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from efficientnerf.asset.captured import captured_metadata
from efficientnerf.asset.format import load, save
from efficientnerf.asset.tree import tree_from_voxels
from efficientnerf.rendering.colour import linear_from_srgb, srgb_from_linear
from efficientnerf.splats.rendering import render
from efficientnerf.training.exposure.model import exposure_of
from pipeline.errors import StageFailed, UsageError
from pipeline.stage import Job
from stages.artifacts import SplatsOutputs
from stages.evaluate.splats import load_splats
from stages.formats.exporters.splats.ply import read_splats
from stages.formats.exporters.writing import source_frame
from stages.io.png import read_png
from stages.io.scene import load as load_scene
from stages.splats import run as splats
from stages.splats.pictures import LONGER_SIDE, photographs, render_cameras, renders
from stages.splats.run import budget_of, gaussians_of
from stages.splats.settings import SplatsSettings
from stages.train import averaged
from tests.efficientnerf.balls import BOUNDS, CENTRE, RADIUS, cameras, picture
from tests.stages.balls import ORBIT, SIMILARITY, poses

QUICK = SplatsSettings(make="on", count=800, sh_degree=1, iterations=6)


def bake(folder: Path, side: int = 24) -> Path:
    """A folder with the asset: the ball that `tests.stages.balls.poses` photographs, on white; of so many voxels a side."""
    voxel = 2 / side
    index = np.argwhere(np.ones((side, side, side), bool))
    away = BOUNDS[0] + (index + 0.5) * voxel - CENTRE
    distance = np.linalg.norm(away, axis=1) - RADIUS
    kept = distance < voxel
    colour = np.clip(0.5 + 0.6 * away[kept], 0.05, 0.95)
    sh = np.log(colour / (1 - colour))[:, None] / 0.28209479
    metadata = {
        "world_from_capture": {"scale": SIMILARITY.scale, "rotation": SIMILARITY.rotation.tolist(), "translation": SIMILARITY.translation.tolist()},
        "orbit": asdict(ORBIT),
        "background": [1.0, 1.0, 1.0],
    }
    density = 100 * np.clip(0.5 - distance[kept] / voxel, 0, 1)
    folder.mkdir()
    save(tree_from_voxels((side // 4,) * 3, voxel, BOUNDS[0], index[kept], density, sh.astype(np.float32), metadata=metadata), folder / "asset.nerftree")
    return folder


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("ball")
    return {"bake": bake(folder / "bake"), "poses": poses(folder / "poses"), "train": folder / "train"}


@pytest.fixture(scope="module")
def made(inputs: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> SplatsOutputs:
    folder = tmp_path_factory.mktemp("splats")
    splats.run(Job(settings=QUICK, inputs=inputs, out=folder / "out", work=folder / "work"))
    return SplatsOutputs(folder / "out")


@pytest.mark.parametrize("known", [True, False], ids=["too small", "full at last"])
def test_a_device_without_the_memory_leaves_the_fit_to_the_cpu(
    known: bool, made: SplatsOutputs, inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit, tries = splats.gaussians_of, []

    def full_at_first(*given: Any) -> Any:
        tries.append(given)
        if len(tries) == 1 and not known:
            raise torch.OutOfMemoryError
        return fit(*given)

    monkeypatch.setattr("stages.memory.device.free_on_device", lambda device: 2**20)
    monkeypatch.setattr(splats, "gaussians_of", full_at_first)
    said: list[dict[str, Any]] = []
    device = "cuda" if known else "cpu"
    splats.run(Job(settings=QUICK, inputs=inputs, out=tmp_path / "out", work=tmp_path / "work", device=device, report=said.append))
    assert len([event for event in said if event["event"] == "warning" and "800 Gaussians" in event["text"]]) == 1
    assert SplatsOutputs(tmp_path / "out").ply.read_bytes() == made.ply.read_bytes()


def test_the_files_hold_the_ball_in_the_capture_s_frame(made: SplatsOutputs, inputs: dict[str, Path]) -> None:
    tree = load(inputs["bake"] / "asset.nerftree")
    found, frame = read_splats(made.ply), source_frame(tree.metadata)
    assert 100 < len(found) <= 800
    assert found.degree <= 1
    distance = np.linalg.norm(frame.world_from_capture.points(found.means) - CENTRE, axis=1)
    assert np.median(distance) == pytest.approx(RADIUS, abs=0.08)
    report = json.loads(made.report.read_text())
    assert report == {"gaussians": len(found), "made": True, "sh_degree": found.degree, "region": "all",
                      "ply_bytes": made.ply.stat().st_size, "spz_bytes": made.spz.stat().st_size}  # fmt: skip
    assert made.spz.stat().st_size < 0.4 * made.ply.stat().st_size
    assert read_png(made.preview).shape == (splats.PREVIEW[1], 2 * splats.PREVIEW[0], 3)


def test_they_are_as_good_as_the_asset_on_views_that_are_held_back(tmp_path: Path) -> None:
    """Within 1.0 dB of it, against photographs that neither was fitted to."""
    from efficientnerf.asset.rendering import render as render_tree

    inputs = {"bake": bake(tmp_path / "bake", 48), "poses": poses(tmp_path / "poses", count=16, side=48), "train": tmp_path / "train"}
    settings = replace(QUICK, count=2000, iterations=40)
    splats.run(Job(settings=settings, inputs=inputs, out=tmp_path / "out", work=tmp_path / "work"))
    tree = load(inputs["bake"] / "asset.nerftree")
    measured = load_splats(SplatsOutputs(tmp_path / "out"), tree)
    views = [view for view in load_scene(inputs["poses"]).views if view.split == "test"]
    for camera in [*(view.camera for view in views), *cameras(20, 48)[16:]]:
        straight = picture(camera) / 255
        photograph = straight[..., :3] * straight[..., 3:] + 1 - straight[..., 3:]
        drawn = (measured.draw(camera, (1.0, 1.0, 1.0)), render_tree(tree, camera, background=(1.0, 1.0, 1.0), normals=False).colour)
        gaussians, asset = (-10 * np.log10(np.square(each - photograph).mean()) for each in drawn)
        assert gaussians > asset - 1.0, camera.name
        assert gaussians > 25, camera.name


def test_the_same_pictures_give_the_same_bytes_and_others_do_not(made: SplatsOutputs, inputs: dict[str, Path], tmp_path: Path) -> None:
    for name, settings in (("again", QUICK), ("own", replace(QUICK, pictures="asset"))):
        splats.run(Job(settings=settings, inputs=inputs, out=tmp_path / name, work=tmp_path / "work"))
    assert (tmp_path / "again/splats.ply").read_bytes() == made.ply.read_bytes()
    assert (tmp_path / "own/splats.ply").read_bytes() != made.ply.read_bytes()


def test_photographs_keep_the_alpha_of_an_object_or_are_masked_by_it(inputs: dict[str, Path]) -> None:
    scene = load_scene(inputs["poses"])
    some = photographs(inputs["poses"], scene, inputs["train"])
    assert [view.camera.name for view in some] == [view.camera.name for view in scene.views if view.split == "train"]
    assert some[0].pixels.shape == (16, 16, 4)
    assert some[0].mask is None
    around = photographs(inputs["poses"], replace(scene, background=None), inputs["train"])
    assert around[0].pixels.shape == (16, 16, 3)
    np.testing.assert_array_equal(around[0].mask, some[0].pixels[..., 3] >= 128)


def test_photographs_are_as_if_all_had_been_exposed_alike(inputs: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    scene = load_scene(inputs["poses"])
    plain = photographs(inputs["poses"], scene, inputs["train"])
    names = [view.image for view in scene.views if view.split == "train"]
    logs = np.log([[2.0, 1.0, 0.5], [0.5, 1.0, 2.0]])
    learned = exposure_of([view.camera for view in scene.views[:2]], logs).detached
    monkeypatch.setattr(averaged, "load_exposure", lambda folder: ([names[1], "another"], learned))
    some = photographs(inputs["poses"], scene, inputs["train"])
    np.testing.assert_array_equal(some[0].pixels, plain[0].pixels)
    light = linear_from_srgb(plain[1].pixels[..., :3] / 255.0) / np.array([2.0, 1.0, 0.5])
    assert np.abs(some[1].pixels[..., :3] - np.rint(255 * srgb_from_linear(light.clip(0, 1)))).max() <= 1
    np.testing.assert_array_equal(some[1].pixels[..., 3], plain[1].pixels[..., 3])


def test_an_asset_alone_is_fitted_to_its_own_renders(inputs: dict[str, Path]) -> None:
    """From the cameras that it keeps, or a turntable's; transparent where it is."""
    tree = load(inputs["bake"] / "asset.nerftree")
    assert render_cameras(tree)[0].width == LONGER_SIDE
    captured = [view.camera for view in load_scene(inputs["poses"]).views]
    kept = tree.with_metadata(captured_path=captured_metadata(captured))
    assert [camera.width for camera in render_cameras(kept)] == [captured[0].width] * len(captured)
    reached: list[tuple[int, int]] = []
    pictures = renders(kept, render_cameras(kept)[:2], lambda done, total, text: reached.append((done, total)))
    assert reached == [(1, 2), (2, 2)]
    assert pictures[0].pixels[0, 0, 3] == 0
    assert pictures[0].pixels[8, 8, 3] == 255
    found = gaussians_of(kept, replace(QUICK, iterations=2), lambda *_: None)
    assert render(found, captured[0]).opacity[8, 8] > 0.5


@pytest.mark.parametrize(
    ("pixels", "count", "steps"),
    [
        ([480 * 360] * 31, 480 * 360, 1080),
        ([640_000] * 100, 280_000, 3600),
        ([800 * 533] * 292, 280_000, 3600),
        ([1008 * 756] * 40, 280_000, 1861),
        ([40_000] * 100, 40_000, 3000),
        ([], 280_000, 1080),
    ],
)
def test_more_pixels_take_more_steps_and_bear_more_gaussians(pixels: list[int], count: int, steps: int) -> None:
    found = budget_of(SplatsSettings(), pixels)
    assert (found.count, found.steps) == (count, steps)
    assert budget_of(SplatsSettings(time_budget=90.0), pixels).steps == min(3 * steps, 8000)
    assert budget_of(SplatsSettings(count=50, iterations=7), pixels).steps == 7
    assert budget_of(SplatsSettings(count=50, iterations=7), pixels).count == 50


@pytest.mark.parametrize("why", ["nothing shows", "too little memory"])
def test_a_run_goes_on_without_them_unless_they_are_asked_for(
    why: str, inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise StageFailed("splats: nothing shows.") if why == "nothing shows" else UsageError("splats: too little memory.")

    monkeypatch.setattr(splats, "gaussians_of", fails)
    told: list[str] = []
    for name, make in (("auto", "auto"), ("on", "on")):
        job = Job(settings=replace(QUICK, make=make), inputs=inputs, out=tmp_path / name / "out", work=tmp_path / name / "work")
        job.report = lambda event: told.append(event.get("text", ""))
        if make == "on":
            with pytest.raises((StageFailed, UsageError), match=why):
                splats.run(job)
        else:
            splats.run(job)
    assert sum("the run continues" in text and why in text for text in told) == 1
    assert json.loads((tmp_path / "auto/out/report.json").read_text())["reason"] == f"splats: {why}."
    assert load_splats(SplatsOutputs(tmp_path / "auto/out"), load(inputs["bake"] / "asset.nerftree")) is None
