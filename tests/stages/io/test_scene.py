"""scene.json: written and read back the same, refused in words where it has been damaged; cameras handed on to nerfstudio."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.geometry.cameras import Similarity, rays, resized
from efficientnerf.geometry.orbit import Orbit
from pipeline.errors import CorruptArtifact
from stages.formats import importers
from stages.formats.exporters import cameras
from stages.io import scene
from stages.io.capture import SparsePoints
from stages.io.scene import Scene, View
from tests.stages import captures
from tests.stages.captures import LENSES, assert_same_rays


def scene_of(model: str = "SIMPLE_PINHOLE") -> Scene:
    made = captures.cameras() if model == "SIMPLE_PINHOLE" else captures.cameras(model=model, params=LENSES[model])
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    world = Similarity(0.5, turn, np.array([0.1, 0.2, 0.3]))
    views = tuple(
        View(
            image=f"images/{camera.name}",
            mask=f"masks/{camera.name}" if index == 0 else None,
            split="test" if index == 0 else "train",
            camera=world.camera(resized(camera, 16, 12)),
            source_camera=camera,
            near=0.1,
            far=3.0,
        )
        for index, camera in enumerate(made)
    )
    return Scene(
        kind="colmap",
        views=views,
        bounds=np.array([[-1, -0.5, -0.5], [1, 0.5, 0.5]]),
        background=(1.0, 1.0, 1.0),
        world_from_capture=world,
        orbit=Orbit((0.0, 0.0, 0.1), 2.0, 20.0, False, -90.0),
        metric=True,
    )


def test_a_scene_comes_back_as_it_was(tmp_path: Path) -> None:
    whole = scene_of("OPENCV")
    scene.save(whole, tmp_path)
    again = scene.load(tmp_path)
    for view, same in zip(whole.views, again.views, strict=True):
        assert (view.image, view.mask, view.split, view.near, view.far) == (same.image, same.mask, same.split, same.near, same.far)
        for camera, other in ((view.camera, same.camera), (view.source_camera, same.source_camera)):
            assert (camera.name, camera.width, camera.height, camera.model, camera.params) == (other.name, other.width, other.height, other.model, other.params)
            np.testing.assert_array_equal(camera.world_from_camera, other.world_from_camera)
    assert (again.kind, again.background, again.orbit, again.points, again.metric) == (whole.kind, whole.background, whole.orbit, False, True)
    np.testing.assert_array_equal(again.bounds, whole.bounds)
    np.testing.assert_array_equal(again.world_from_capture.matrix(), whole.world_from_capture.matrix())
    assert [len(scene.views_of(again, split)) for split in ("train", "val", "test", "report")] == [5, 0, 1, 1]
    (tmp_path / "again").mkdir()
    scene.save(again, tmp_path / "again")
    assert (tmp_path / "again/scene.json").read_bytes() == (tmp_path / "scene.json").read_bytes()


def set_in(*path: Any) -> Callable[[Any], None]:
    """A change of a document: all but the last of the arguments lead to the value, the last replaces it."""
    *way, last, value = path

    def change(document: Any) -> None:
        for step in way:
            document = document[step]
        document[last] = value

    return change


DAMAGE: dict[str, tuple[Callable[[Any], None], str]] = {
    "newer": (set_in("format", 3), "version 3"),
    "older": (set_in("format", 0), "version 0"),
    "no views": (set_in("views", None), r"\$\.views"),
    "split": (set_in("views", 0, "split", "all"), r"views\[0\]: split 'all'"),
    "near": (set_in("views", 0, "near", 4.0), "near 4.0"),
    "pose": (set_in("views", 1, "camera", "world_from_camera", 0, 0, 7.0), "rigid"),
    "pose shape": (set_in("views", 1, "camera", "world_from_camera", [[1]]), r"views\[1\]\.camera\.world_from_camera"),
    "model": (set_in("views", 1, "camera", "model", "FOV"), "FOV"),
    "a model of a long name": (set_in("views", 1, "camera", "model", "x" * 100_000), "xxx"),
    "size": (set_in("views", 1, "camera", "width", 0), r"views\[1\]\.camera\.width"),
    "focal length": (set_in("views", 1, "camera", "params", 0, 0.0), "focal length"),
    "truth for a number": (set_in("views", 1, "near", True), "bool"),
    "an integer of 400 digits": (set_in("views", 1, "near", 10**400), r"scene\.json"),
    "outside": (set_in("views", 1, "image", "../x.png"), "outside"),
    "absolute": (set_in("views", 0, "mask", "/etc/x.png"), "outside"),
    "bounds": (set_in("bounds", [[1, 1, 1], [0, 0, 0]]), "bounds"),
    "scale": (set_in("world_from_capture", "scale", -1.0), r"world_from_capture\.scale"),
    "background": (set_in("background", [1, 1]), r"\$\.background"),
    "no space": (set_in("space", None), "without"),
    "a space without its camera": (set_in("space", "ndc"), "'ndc'"),
    "infinity": (lambda document: document["orbit"].update(radius=float("1e999")), "Infinity|radius"),
}


@pytest.mark.parametrize("what", DAMAGE)
def test_a_damaged_scene_is_refused(what: str, tmp_path: Path) -> None:
    scene.save(scene_of(), tmp_path)
    document = json.loads((tmp_path / "scene.json").read_text())
    change, word = DAMAGE[what]
    change(document)
    (tmp_path / "scene.json").write_text(json.dumps(document))
    with pytest.raises(CorruptArtifact, match=word) as caught:
        scene.load(tmp_path)
    assert caught.value.exit_code == 4
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 700


def test_images_and_masks_are_read_as_written(tmp_path: Path) -> None:
    view = scene_of().views[0]
    for channels in (3, 4):
        pixels = captures.picture(1, 16, 12, channels)
        captures.write_picture(tmp_path / view.image, pixels)
        np.testing.assert_array_equal(scene.read_image(tmp_path, view), pixels)
    mask = np.where(captures.picture(2, 16, 12)[..., 0] > 100, np.uint8(255), np.uint8(0))
    captures.write_picture(tmp_path / "masks/img_0.png", mask)
    np.testing.assert_array_equal(scene.read_mask(tmp_path, view), mask == 255)
    assert scene.read_mask(tmp_path, scene_of().views[1]) is None


def test_points_come_back_as_they_were(tmp_path: Path) -> None:
    for tracks in [((0, 2), (), (5,)), ()]:
        count = len(tracks)
        points = SparsePoints(np.ones((count, 3)), np.full((count, 3), 7, np.uint8), np.full(count, np.nan), tracks)
        scene.save_points(points, tmp_path)
        again = scene.read_points(tmp_path)
        np.testing.assert_array_equal(again.xyz, points.xyz)
        np.testing.assert_array_equal(again.rgb, points.rgb)
        assert again.tracks == tracks
    saved = tmp_path / "points.safetensors"
    beside = tmp_path / "beside"
    beside.write_bytes(b"nothing")
    assert saved.stat().st_mode == beside.stat().st_mode  # whoever may read the run can verify it
    saved.write_bytes(b"nothing")
    with pytest.raises(CorruptArtifact, match=r"points\.safetensors"):
        scene.read_points(tmp_path)


@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", *LENSES])
def test_exported_cameras_are_those_of_the_source(model: str, tmp_path: Path) -> None:
    whole = scene_of(model)
    named = replace(whole, views=tuple(replace(view, source_camera=replace(view.source_camera, name=view.image)) for view in whole.views))
    named = replace(named, views=tuple(replace(view, camera=replace(view.camera, name=view.image)) for view in named.views))
    captures.write_pictures(tmp_path, [view.image for view in named.views])
    cameras.write(named, tmp_path / "transforms.json")
    capture = importers.IMPORTERS["nerfstudio"].read(tmp_path, captures.Settings())
    truth = captures.cameras() if model == "SIMPLE_PINHOLE" else captures.cameras(model=model, params=LENSES[model])
    assert_same_rays(capture, truth)
    assert [photo.split for photo in capture.photos].count("test") == 1
    document = json.loads((tmp_path / "transforms.json").read_text())
    assert document["fl_x"] == 40.0 or model == "OPENCV_FISHEYE"
    assert rays(capture.photos[0].camera)[1].shape == (768, 3)
