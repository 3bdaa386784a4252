"""The poses stage: any source becomes a scene that stands on its own."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from efficientnerf.geometry.cameras import project
from pipeline.errors import BadInput, UsageError
from pipeline.stage import settings_from
from stages.io import scene
from stages.io.capture import Capture, Photo
from stages.io.scene import Scene
from stages.poses import run as poses
from stages.poses.run import assign_splits
from stages.poses.settings import PosesSettings
from stages.sfm.reconstruction import Request
from tests.stages import captures
from tests.stages.captures import HEIGHT, SHARED, WIDTH, WRITERS


def run(source: Path, out: Path, **settings: Any) -> tuple[Scene, list[str]]:
    """The scene, and the warnings."""
    events: list[dict[str, Any]] = []
    poses.run(captures.poses_job(source, out, events.append, **settings))
    return scene.load(out / "poses"), [event["text"] for event in events if event["event"] == "warning"]


@pytest.mark.parametrize("how", WRITERS)
def test_every_format_becomes_a_scene(how: str, tmp_path: Path) -> None:
    source = WRITERS[how][1](tmp_path / "source")
    made, warnings = run(source, tmp_path)
    shutil.rmtree(source)
    folder = tmp_path / "poses"
    assert not warnings
    assert len(made.views) == 6
    assert {view.name.rsplit("/", 1)[-1] for view in made.views} == {f"img_{i}.png" for i in range(6)}
    assert [view.split for view in made.views].count("test") == (2 if how == "blender" else 1)
    np.testing.assert_allclose(np.abs(made.bounds).max(), 1)
    truth = {camera.name: camera for camera in captures.cameras()}
    inside = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
    for view in made.views:
        assert scene.read_image(folder, view).shape == (HEIGHT, WIDTH, 4 if how == "blender" else 3)
        camera = truth[view.name.rsplit("/", 1)[-1]]
        np.testing.assert_allclose(view.source_camera.world_from_camera, camera.world_from_camera, atol=1e-6)
        # The same point, mapped to the training frame, is seen on the same spot.
        np.testing.assert_allclose(project(view.camera, made.world_from_capture.points(inside))[0], project(camera, inside)[0], atol=1e-4)
    assert made.points == (WRITERS[how][0] == "colmap")
    if made.points:
        points = scene.read_points(folder)
        np.testing.assert_allclose(np.sort(made.world_from_capture.inverse().points(points.xyz), 0), np.sort(captures.sparse_points(), 0))
    with Image.open(folder / "contact_sheet.png") as sheet:
        assert sheet.width > 500
    report = json.loads((folder / "report.json").read_text())
    assert len(report["registered"]) == 6
    assert report["rejected"] == []


def test_the_same_source_gives_the_same_bytes(tmp_path: Path) -> None:
    source = captures.colmap_txt(tmp_path / "source")
    for out in ("a", "b"):
        run(source, tmp_path / out)
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*") if path.is_file())
    assert len(files) == 13
    assert all((tmp_path / "a" / path).read_bytes() == (tmp_path / "b" / path).read_bytes() for path in files)


def test_unchanged_images_are_copied_and_others_are_lossless(tmp_path: Path) -> None:
    source = captures.nerfstudio(tmp_path / "source")
    images = source / "images"
    smooth = np.broadcast_to(np.linspace(0, 65535, WIDTH).astype(np.uint16), (HEIGHT, WIDTH))
    Image.fromarray(smooth).save(images / "img_1.png")  # 16 bits, grey
    captures.write_picture(images / "img_2.png", captures.picture(2)[..., 0])  # 8 bits, grey
    Image.fromarray(captures.picture(3)).convert("P").save(images / "img_3.png")
    made, _ = run(source, tmp_path)
    folder = tmp_path / "poses"
    assert (folder / "images/img_0.png").read_bytes() == (images / "img_0.png").read_bytes()
    sixteen = scene.read_image(folder, made.views[1])
    np.testing.assert_array_equal(sixteen[..., 0], np.rint(smooth / 257))
    np.testing.assert_array_equal(scene.read_image(folder, made.views[2]), np.repeat(captures.picture(2)[..., :1], 3, -1))
    assert scene.read_image(folder, made.views[3]).shape == (HEIGHT, WIDTH, 3)
    assert len({view.camera.world_from_camera.shape for view in made.views}) == 1


def test_jpegs_are_copied_and_reduced_ones_become_png(tmp_path: Path) -> None:
    source = captures.llff(tmp_path / "source")
    for index in range(6):
        (source / f"images_4/img_{index}.png").unlink()
        captures.write_picture(source / f"images_4/img_{index}.jpg", captures.picture(index))
    made, _ = run(source, tmp_path / "a")
    assert made.views[0].image == "images/img_0.jpg"
    assert (tmp_path / "a/poses/images/img_0.jpg").read_bytes() == (source / "images_4/img_0.jpg").read_bytes()
    small, _ = run(source, tmp_path / "b", max_image_size=16)  # below the limit of the setting, which only the command line checks
    assert small.views[0].image == "images/img_0.png"
    assert (small.views[0].camera.width, small.views[0].camera.height) == (16, 12)
    assert small.views[0].source_camera.width == WIDTH


def test_exif_rotation_is_applied(tmp_path: Path) -> None:
    upright = captures.picture(0, HEIGHT, WIDTH)  # stored on its side it is 32 x 24
    made_for = captures.cameras(params=(captures.FOCAL, HEIGHT / 2, WIDTH / 2))
    source = captures.nerfstudio(tmp_path / "source", made_for, w=HEIGHT, h=WIDTH, cx=HEIGHT / 2, cy=WIDTH / 2)
    exif = Image.Exif()
    exif[0x0112] = 6  # turn by 90 degrees clockwise to see it upright
    for index in range(6):
        captures.write_picture(source / f"images/img_{index}.png", np.rot90(upright), exif=exif)
    made, _ = run(source, tmp_path)
    np.testing.assert_array_equal(scene.read_image(tmp_path / "poses", made.views[0]), upright)
    assert (made.views[0].source_camera.width, made.views[0].source_camera.height) == (HEIGHT, WIDTH)
    np.testing.assert_allclose(made.views[0].source_camera.world_from_camera, made_for[0].world_from_camera, atol=1e-9)


def test_a_truncated_image_is_named_and_left_out(tmp_path: Path) -> None:
    source = captures.colmap_bin(tmp_path / "source")
    path = source / "images/img_2.png"
    path.write_bytes(path.read_bytes()[:1500])
    made, warnings = run(source, tmp_path / "a")
    assert [view.name for view in made.views] == [f"images/img_{i}.png" for i in (0, 1, 3, 4, 5)]
    assert any("1 of 6 images cannot be used: images/img_2.png unreadable: " in warning for warning in warnings)
    assert scene.read_points(tmp_path / "a/poses").tracks[0] == (0, 1, 2, 3, 4)
    report = json.loads((tmp_path / "a/poses/report.json").read_text())
    assert report["rejected"][0]["name"] == "images/img_2.png"
    with pytest.raises(BadInput, match="--strict"):
        run(source, tmp_path / "b", strict=True)
    for index in (0, 1, 3):
        (source / f"images/img_{index}.png").write_bytes(path.read_bytes())
    with pytest.raises(BadInput, match=r"4 of 6 .*img_0.png"):
        run(source, tmp_path / "c")


def alpha_set(folder: Path, opaque: int = 0, without: int = 0) -> Path:
    """A Blender set whose images are transparent on the left; the first `opaque` nowhere, the first `without` have no alpha channel."""
    source = captures.blender(folder)
    for index in range(6):
        pixels = captures.picture(index, channels=4)
        pixels[..., 3] = 255
        pixels[:, : 0 if index < opaque else WIDTH // 2, 3] = 0
        captures.write_picture(source / ("train" if index < 4 else "test") / f"img_{index}.png", pixels[..., :3] if index < without else pixels)
    return source


@pytest.mark.parametrize(("opaque", "without", "alpha"), [(1, 1, "auto"), (0, 0, "ignore")])
def test_other_alpha_masks(tmp_path: Path, opaque: int, without: int, alpha: str) -> None:
    made, _ = run(alpha_set(tmp_path / "source", opaque, without), tmp_path, masks=alpha)
    assert made.background is None
    for index, view in enumerate(made.views):
        assert scene.read_image(tmp_path / "poses", view).shape[2] == 3
        mask = scene.read_mask(tmp_path / "poses", view)
        if index < max(opaque, without):
            assert mask is None
        else:
            np.testing.assert_array_equal(mask, np.broadcast_to(np.arange(WIDTH) >= WIDTH // 2, (HEIGHT, WIDTH)))


@pytest.mark.parametrize("masks", ["auto", "ignore"])
def test_masks_are_made_from_a_green_screen(tmp_path: Path, masks: str) -> None:
    """Of photographs that have none; as silhouettes, unless they are to be ignored."""
    made = captures.cameras()
    source = captures.nerfstudio(tmp_path / "nerfstudio", made)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    for index, camera in enumerate(made):
        inside = np.hypot(x - WIDTH / 2, y - HEIGHT / 2) < 6 + index % 2
        captures.write_picture(source / "images" / camera.name, np.where(inside[..., None], captures.picture(index), np.uint8([60, 190, 80])))
    with pytest.raises(UsageError, match="#rrggbb"):
        settings_from(PosesSettings, {"mask_from": "purple"})
    plain, _ = run(source, tmp_path / "a")
    assert plain.background is None
    assert all(view.mask is None for view in plain.views)
    keyed, _ = run(source, tmp_path / "b", mask_from="green", masks=masks)
    assert keyed.background == (None if masks == "ignore" else (1.0, 1.0, 1.0))
    assert all(view.mask is not None for view in keyed.views) == (masks == "ignore")
    with pytest.raises(BadInput, match="--mask #800080"):
        run(source, tmp_path / "c", mask_from="#800080")


def test_masks_of_another_size(tmp_path: Path) -> None:
    source = captures.colmap_bin(tmp_path / "source")
    mask = np.zeros((2 * HEIGHT, 2 * WIDTH), np.uint8)
    mask[:HEIGHT] = 255
    captures.write_picture(source / "masks/img_0.png", mask)
    made, warnings = run(source, tmp_path / "a")
    assert any("the mask is 64x48, its image 32x24; it was resized" in warning for warning in warnings)
    np.testing.assert_array_equal(scene.read_mask(tmp_path / "a/poses", made.views[0]), mask[::2, ::2] == 255)
    captures.write_picture(source / "masks/img_0.png", mask[:, :40])
    with pytest.raises(BadInput, match=r"masks/img_0.png: .*40x48.*32x24"):
        run(source, tmp_path / "b")
    (source / "masks/img_0.png").write_bytes(b"nothing")
    made, warnings = run(source, tmp_path / "c")
    assert len(made.views) == 5
    assert any("its mask img_0.png is unreadable" in warning for warning in warnings)


def photos(splits: list[str | None]) -> list[Photo]:
    return [Photo(camera, Path(camera.name), split=split) for camera, split in zip(captures.cameras(len(splits)), splits, strict=True)]


def held_out(count: int) -> list[int]:
    """Which of so many photographs in sorted order are test views."""
    unsplit = photos([None] * count)
    named = sorted(zip([photo.camera.name for photo in unsplit], assign_splits(unsplit, 8), strict=True))
    return [index for index, (_, split) in enumerate(named) if split == "test"]


def test_splits() -> None:
    assert assign_splits(photos(["train", "train", "test", "val"]), 8) == ["train", "train", "test", "val"]
    assert held_out(17) == [0, 8, 16]
    assert held_out(16) == [0, 8]
    assert held_out(15) == [4, 12]
    assert held_out(9) == [4], "the ends of an arc are not held out"
    assert assign_splits(photos(["train"] * 9), 8).count("test") == 1, "nothing is held back by the source"
    assert assign_splits(photos([None] * 3), 8) == ["train", "test", "train"]
    assert assign_splits(photos([None] * 3), 2).count("train") == 2
    assert assign_splits(photos([None] * 2), 8) == ["train"] * 2
    said: list[str] = []
    assert assign_splits(photos(["test"] * 8 + ["train"]), 8, said.append).count("train") == 8
    assert "at least 2" in said[0]
    assert assign_splits(photos(["train", "train", "test", None]), 8, said.append)[3] == "train"
    assert "1 images are in none" in said[1]


def test_photographs_get_their_cameras_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tmp_path / "source"
    made = captures.cameras()
    captures.write_pictures(source, [camera.name for camera in made])
    captures.write_picture(source / "masks/img_1.png", np.eye(HEIGHT, WIDTH, dtype=np.uint8) * 255)
    asked: dict[str, Any] = {}

    def find_cameras(request: Request, **callables: Any) -> Capture:
        asked.update(vars(request))
        found = tuple(Photo(camera, request.folder / camera.name, request.masks.get(camera.name)) for camera in made[:5])
        callables["warn"]("one was not registered")
        return Capture(kind="photographs", photos=found, background=None, rejected=(("img_5.png", "overlaps no other"),), warnings=("one was not registered",))

    monkeypatch.setattr("stages.masking.photographs.find_cameras", find_cameras)
    whole, warnings = run(source, tmp_path / "a", max_features=1000, matching="sequential", feature_image_size=800, seed=3)
    assert (asked["features"], asked["matching"], asked["max_side"], asked["seed"]) == (1000, "sequential", 800, 3)
    assert [*asked["paths"]] == [camera.name for camera in made]
    assert asked["work"].is_relative_to(tmp_path / "a/work")
    assert warnings[0] == "one was not registered"
    assert [warning.partition(":")[0] for warning in warnings[1:]] == ["6 of 6 photographs are too small, 32 px on the longest side"]
    assert len(whole.views) == 5
    assert whole.views[1].mask == "masks/img_1.png"
    assert json.loads((tmp_path / "a/poses/report.json").read_text())["rejected"] == [{"name": "img_5.png", "reason": "overlaps no other"}]
    with pytest.raises(BadInput, match=r"img_5.png"):
        run(source, tmp_path / "b", strict=True)


def test_a_box_and_an_up_axis_can_be_set(tmp_path: Path) -> None:
    made, _ = run(captures.colmap_bin(tmp_path / "source"), tmp_path, up="z", crop_box=(-1.0, -0.5, -0.25, 1.0, 0.5, 0.25))
    np.testing.assert_allclose(made.bounds, [[-1, -0.5, -0.25], [1, 0.5, 0.25]], atol=1e-12)
    np.testing.assert_allclose(made.world_from_capture.matrix(), np.eye(4), atol=1e-12)


def test_real_photographs_with_colmap_cameras(tmp_path: Path) -> None:
    source = SHARED / "lund_door_colmap"
    if not source.is_dir():
        pytest.skip(f"{source} is not there")
    made, warnings = run(source, tmp_path, max_image_size=256)
    assert not warnings
    assert len(made.views) == 12
    points = scene.read_points(tmp_path / "poses")
    assert len(points.xyz) == 11384
    view = made.views[0]
    pixels, depth = project(view.camera, points.xyz[[0 in seen for seen in points.tracks]])
    assert ((pixels >= 0) & (pixels <= (view.camera.width, view.camera.height))).all()
    assert view.near < np.quantile(depth, 0.01)
    assert np.quantile(depth, 0.99) < view.far


def test_a_model_of_few_of_the_photographs_is_not_taken_without_a_word(tmp_path: Path) -> None:
    source = captures.colmap_txt(tmp_path / "source")
    _, warnings = run(source, tmp_path / "whole")
    assert not [text for text in warnings if "--as photographs" in text]
    captures.write_pictures(source / "images", [f"more_{k}.png" for k in range(10, 24)])
    made, warnings = run(source, tmp_path / "part")
    assert len(made.views) == 6
    assert [text for text in warnings if "6 of the 20 photographs in the folder" in text and "--as photographs" in text]
    said = json.loads((tmp_path / "part/poses/verdict.json").read_text())
    assert said["grade"] == "poor"
    around = np.array([view.camera.centre for view in made.views]) - made.orbit.centre
    elevation = np.degrees(np.arcsin(around[:, 2] / np.linalg.norm(around, axis=1)))
    assert said["coverage"]["elevation"] == pytest.approx(np.median(elevation), abs=0.1)
    assert 0 < said["coverage"]["arc"] <= 360
