"""Baking whole scenes: all that the photographs show, within the asset's size, to the same bytes whatever happens on the way."""

import hashlib
import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from efficientnerf.asset import field_samples, format
from efficientnerf.asset.cascades import cascades_of, voxel_cascades, voxel_coordinates
from efficientnerf.asset.rendering import render
from efficientnerf.asset.tree import NerfTree
from efficientnerf.geometry.cameras import rays
from efficientnerf.rendering import environment
from efficientnerf.rendering.colour import linear_from_srgb, srgb_from_linear
from efficientnerf.rendering.field_renderer import FieldRenderer
from efficientnerf.training.exposure.model import exposure_of
from pipeline.errors import Interrupted, UsageError
from stages.artifacts import BakeOutputs, TrainOutputs
from stages.bake import pruning, whole_scene
from stages.bake import run as bake
from stages.bake.resolution import MAX_CELLS, MAX_MIB, SCENE_BYTES, SCENE_MAX_MIB, finest_of_cascades, usual_mib
from stages.bake.settings import BakeSettings
from stages.framing.view_coverage import close_to_path
from stages.io.png import read_png, write_png
from stages.io.scene import Scene, View, load, save
from stages.train import averaged
from tests.efficientnerf.surroundings import around, photographs, surroundings
from tests.stages.balls import ORBIT, SIMILARITY, StopAt, job
from tests.stages.spoilers import SPOILERS

QUICK = BakeSettings(resolution=40, samples_per_voxel=1, refine_steps=8, refine_rays_per_batch=2048, environment_size=16, visibility_rays=20_000)
BOUNDS = np.array([[-1.0] * 3, [1.0] * 3])


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("scene")
    (folder / "poses" / "images").mkdir(parents=True)
    (folder / "train").mkdir()
    (folder / "train" / TrainOutputs.field).write_bytes(b"in closed form")
    cameras = around(9)
    for camera, image in zip(cameras, photographs(surroundings(), cameras), strict=True):
        write_png(image, folder / "poses" / "images" / camera.name)
    views = tuple(View(f"images/{c.name}", None, "test" if n == 8 else "train", c, SIMILARITY.inverse().camera(c), 0.2, 60.0) for n, c in enumerate(cameras))
    save(Scene("photographs", views, BOUNDS, None, SIMILARITY, ORBIT, metric=False), folder / "poses")
    return {"poses": folder / "poses", "train": folder / "train"}


@pytest.fixture(scope="module", autouse=True)
def field_in_closed_form() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stages.bake.run.load_renderer", lambda folder, device="cpu": FieldRenderer(surroundings(), 0.2, 60.0))
        patch.setattr(field_samples, "RAYS_PER_BLOCK", 2048)
        yield


def baked(folder: Path, inputs: dict[str, Path], events: list[dict[str, Any]] | None = None, **changes: Any) -> tuple[NerfTree, dict[str, Any]]:
    made = job(folder, replace(QUICK, **changes), events=events, **inputs)
    bake.run(made)
    return format.load(made.out / BakeOutputs.asset), json.loads((made.out / "report.json").read_text())


def digest(folder: Path) -> str:
    return hashlib.sha256((folder / "out" / BakeOutputs.asset).read_bytes() + (folder / "out" / "report.json").read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def undisturbed(inputs: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    """The folder of a bake, and how often it could have been stopped."""
    folder, never = tmp_path_factory.mktemp("undisturbed"), StopAt()
    bake.run(job(folder, QUICK, stop=never, **inputs))
    return folder, never.count


def test_a_size_that_the_environment_map_fills_is_refused_early(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("stages.bake.whole_scene.field_samples", lambda *_: pytest.fail("the field was rendered"))
    for changes, lower in (({"resolution": "auto"}, "lower "), ({}, r"lower bake\.resolution or ")):
        with pytest.raises(UsageError, match=rf"max_mib=5.*1024 rows.*{lower}bake\.environment_size"):
            baked(tmp_path, inputs, max_mib=5.0, environment_size=1024, **changes)


def test_what_training_learned_of_the_exposure_is_left_out_of_the_asset(
    inputs: dict[str, Path], tmp_path: Path, undisturbed: tuple[Path, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Photographs half of which were exposed less: with that known the asset is as good as of those that were not."""
    shutil.copytree(inputs["poses"], tmp_path / "poses")
    names, logs = [f"images/{camera.name}" for camera in around(9)[:8]], 0.25 * (-1.0) ** np.arange(8)
    for name, log in zip(names, logs, strict=True):
        path = tmp_path / "poses" / name
        light = linear_from_srgb(read_png(path) / 255.0) * np.exp(log)
        write_png(np.rint(255 * srgb_from_linear(light.clip(0, 1))).astype(np.uint8), path)
    e = exposure_of(around(9)[:8], logs[:, None] * np.ones(3)).detached
    psnr = {}
    for known in (True, False):
        monkeypatch.setattr(averaged, "load_exposure", lambda folder, known=known: (names, e) if known else None)
        _, report = baked(tmp_path / str(known), {**inputs, "poses": tmp_path / "poses"})
        psnr[known] = report["optimisation"]["psnr_after"]
    usual = json.loads((undisturbed[0] / "out" / "report.json").read_text())["optimisation"]["psnr_after"]
    assert psnr[True] == pytest.approx(usual, abs=0.3)
    assert psnr[False] < usual - 1


def test_the_environment_map_shows_what_photographs_do_where_the_sky_of_the_field_is_another(
    inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other, camera = surroundings(), around(9)[0]
    with torch.no_grad():
        other.sky.sh[0] += 3.0
    monkeypatch.setattr("stages.bake.run.load_renderer", lambda folder, device="cpu": FieldRenderer(other, 0.2, 60.0))
    tree, _ = baked(tmp_path, inputs)
    taken = FieldRenderer(surroundings(), 0.2, 60.0).render(camera)
    _, directions = rays(camera)
    clear = (taken.opacity < 0.01).ravel()
    assert clear.sum() > 50
    shown = environment.lookup(tree.environment, directions[clear])  # type: ignore[arg-type]
    wrong = np.abs(other.sky(torch.from_numpy(directions[clear].astype(np.float32))).detach().numpy() - taken.colour.reshape(-1, 3)[clear])
    assert wrong.mean() > 0.05
    assert np.abs(shown - taken.colour.reshape(-1, 3)[clear]).mean() < 0.2 * wrong.mean()


def test_the_same_twice_and_stopped_anywhere(inputs: dict[str, Path], tmp_path: Path, undisturbed: tuple[Path, int]) -> None:
    wanted, calls = digest(undisturbed[0]), undisturbed[1]
    for k, call in enumerate((2, calls - 1)):
        stop = StopAt(call)
        with pytest.raises(Interrupted):
            bake.run(job(tmp_path / str(k), QUICK, stop=stop, **inputs))
        stop.calls = set()
        bake.run(job(tmp_path / str(k), QUICK, stop=stop, **inputs))
        assert digest(tmp_path / str(k)) == wanted


def test_scratch_that_is_damaged_is_made_again(inputs: dict[str, Path], tmp_path: Path, undisturbed: tuple[Path, int]) -> None:
    stop = StopAt(undisturbed[1])
    with pytest.raises(Interrupted):
        bake.run(job(tmp_path, QUICK, stop=stop, **inputs))
    stop.calls = set()
    names = {path.name.partition("_")[0] for path in (tmp_path / "work").iterdir()}
    assert {"samples", "samples.json", "cascade0", "refinement.safetensors"} <= names
    for path in list((tmp_path / "work").iterdir()):
        SPOILERS["zero"](path)
    events: list[dict[str, Any]] = []
    bake.run(job(tmp_path, QUICK, stop=stop, events=events, **inputs))
    assert digest(tmp_path) == digest(undisturbed[0])
    warned = [event["text"].partition(" ")[0] for event in events if event["event"] == "warning"]
    assert {"samples.json", "cascade0_000000.json", "refinement.safetensors"} <= set(warned)


def test_holes_are_found_and_their_voxels_restored(inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the prune drops a piece of the ball that the photographs show it comes back, within the room there is."""
    heaviest = pruning.heaviest
    dropped: list[int] = []

    def without_half(made: Any, greatest: np.ndarray, most: int) -> np.ndarray:
        keep = heaviest(made, greatest, most)
        lost = np.zeros(len(keep), bool)
        lost[: int(0.4 * len(keep))] = True  # a half of the innermost cascade, along x
        dropped.append(int((lost & keep).sum()))
        return keep & ~lost

    monkeypatch.setattr(pruning, "heaviest", without_half)
    events: list[dict[str, Any]] = []
    _, report = baked(tmp_path, inputs, events)
    found = report["optimisation"]["holes"]
    assert dropped[0] > 500
    assert found["pruned"] > 0.02
    assert found["restored"] < 0.2 * found["pruned"]
    assert 0 < found["voxels_restored"] <= dropped[0]
    assert any("holes" in event.get("text", "") and "restored" in event["text"] for event in events)


def test_what_lies_just_past_the_borders_of_images_is_baked(inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the field shows it, for the next view; within the size that an asset may have."""
    s = load(inputs["poses"])
    poses = tmp_path / "poses"
    shutil.copytree(inputs["poses"], poses)
    save(replace(s, views=tuple(replace(view, split="train" if number in (0, 3) else "test") for number, view in enumerate(s.views))), poses)
    own = s.views[0].camera
    params = (own.params[0], own.params[1] + 0.15 * own.width, own.params[2] + 0.15 * own.height)
    wide = replace(own, width=round(1.3 * own.width), height=round(1.3 * own.height), params=params)
    few = {**inputs, "poses": poses}
    asset, _ = baked(tmp_path / "with", few, max_mib=0.5)
    monkeypatch.setattr(whole_scene, "PAST_SHARE", 0.0)
    without, _ = baked(tmp_path / "without", few, max_mib=0.5)
    seen = FieldRenderer(surroundings(), 0.2, 60.0).render(wide).opacity > 0.9
    past = np.ones(seen.shape, bool)
    past[int(0.14 * own.height) : int(1.16 * own.height), int(0.14 * own.width) : int(1.16 * own.width)] = False
    ring = seen & past
    assert ring.sum() > 50
    assert render(asset, wide).opacity[ring].mean() > 0.9 > 0.8 > render(without, wide).opacity[ring].mean()
    assert (tmp_path / "with" / "out" / BakeOutputs.asset).stat().st_size <= 2**19


def test_nothing_is_baked_where_the_cameras_pass(inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nearer planes far out make room that is known to be filled: there is the wall, of which what is near the cameras is left out."""
    monkeypatch.setattr(whole_scene, "BAKED_CLEARANCE", 1.5)  # of half of the way to the middle, which reaches the wall
    s = load(inputs["poses"])
    poses = tmp_path / "poses"
    shutil.copytree(inputs["poses"], poses)
    cameras, near = [view.camera for view in s.views if view.split == "train"], 2.4
    save(replace(s, views=tuple(replace(view, near=near) for view in s.views)), poses)

    def close(made: NerfTree) -> int:
        at, of = voxel_coordinates(made), voxel_cascades(made)
        centres = np.concatenate([(at[of == n] + 0.5) * grid.voxel + grid.bounds_min for n, grid in enumerate(cascades_of(made))])
        return int(close_to_path(centres, cameras, [near] * len(cameras), whole_scene.BAKED_CLEARANCE).sum())

    with_room = baked(tmp_path / "room", {**inputs, "poses": poses}, refine_steps=0)[0]
    without = baked(tmp_path / "none", inputs, refine_steps=0)[0]
    assert close(without) > 0
    assert close(with_room) == 0


def test_a_scene_is_as_fine_as_pixels_cells_and_settings_allow(inputs: dict[str, Path]) -> None:
    s = load(inputs["poses"])
    box = np.array([[-0.5, -0.5, -0.25], [0.5, 0.5, 0.25]])
    free = finest_of_cascades(s, box, 4, 4, None)
    assert free.resolution == max(32, round(1.0 / (1.7 / (0.8 * 32))))
    sharp = replace(s, views=tuple(replace(v, camera=replace(v.camera, params=(1e5, 16.0, 16.0))) for v in s.views))
    held = finest_of_cascades(sharp, box, 4, 4, None)
    assert 4 * 0.5 * (held.resolution / 4) ** 3 <= MAX_CELLS
    assert held.resolution > 384
    assert finest_of_cascades(sharp, box, 4, 4, 99).resolution == 99
    assert usual_mib(s) == MAX_MIB
    many = replace(s, views=s.views + tuple(replace(v, camera=replace(v.camera, width=9000, height=10000), split="train") for v in s.views[:1]))
    assert usual_mib(many) == pytest.approx(SCENE_BYTES * 9e7 / 2**20, rel=1e-3)
    assert usual_mib(replace(many, views=many.views + many.views[-1:])) == SCENE_MAX_MIB
    assert usual_mib(replace(many, background=(1.0, 1.0, 1.0))) == MAX_MIB
