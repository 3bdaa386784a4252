"""The poses stage: any source becomes a scene that stands on its own."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from efficientnerf.geometry.cameras import project
from pipeline.errors import BadInput
from pipeline.stage import Job
from stages.io import scene
from stages.io.capture import Capture, Photo
from stages.io.scene import Scene
from stages.poses import run as poses
from stages.poses.settings import PosesSettings
from tests.stages import captures
from tests.stages.captures import HEIGHT, SHARED, WIDTH


def run(source: Path, out: Path, **settings: Any) -> tuple[Scene, list[str]]:
    """The scene, and the warnings."""
    events: list[dict[str, Any]] = []
    job = Job(settings=PosesSettings(**settings), out=out / "poses", work=out / "work", source=source, stage="poses", report=events.append)
    poses.run(job)
    return scene.load(out / "poses"), [event["text"] for event in events if event["event"] == "warning"]


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


def test_photographs_get_their_cameras_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tmp_path / "source"
    made = captures.cameras()
    captures.write_pictures(source, [camera.name for camera in made])
    captures.write_picture(source / "masks/img_1.png", np.eye(HEIGHT, WIDTH, dtype=np.uint8) * 255)
    asked: dict[str, Any] = {}

    def find_cameras(folder: Path, names: list[str], **options: Any) -> Capture:
        asked.update(options, names=names)
        found = tuple(Photo(camera, folder / camera.name, options["masks"].get(camera.name)) for camera in made[:5])
        options["warn"]("one was not registered")
        return Capture(kind="photographs", photos=found, background=None, rejected=(("img_5.png", "overlaps no other"),), warnings=("one was not registered",))

    monkeypatch.setattr("stages.masking.photographs.find_cameras", find_cameras)
    whole, warnings = run(source, tmp_path / "a", max_features=1000, matching="sequential", feature_image_size=800, seed=3)
    assert (asked["features"], asked["matching"], asked["max_side"], asked["seed"]) == (1000, "sequential", 800, 3)
    assert [*asked["names"]] == [camera.name for camera in made]
    assert asked["work"].is_relative_to(tmp_path / "a/work")
    assert warnings[0] == "one was not registered"
    assert [warning.partition(":")[0] for warning in warnings[1:]] == ["6 of 6 photographs are too small, 32 px on the longest side"]
    assert len(whole.views) == 5
    assert whole.views[1].mask == "masks/img_1.png"
    assert json.loads((tmp_path / "a/poses/report.json").read_text())["rejected"] == [{"name": "img_5.png", "reason": "overlaps no other"}]
    with pytest.raises(BadInput, match=r"img_5.png"):
        run(source, tmp_path / "b", strict=True)


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
