"""Masks and alpha channels: silhouettes of an object, or pixels to be ignored; decided, said, and what becomes of them."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.geometry.cameras import Camera, rays
from stages.io import scene, working_images
from stages.io.capture import Capture, Photo
from stages.io.scene import Scene
from stages.poses import run as poses
from stages.sfm.reconstruction import Request
from tests.stages import captures
from tests.stages.captures import HEIGHT, WIDTH

BALL, RADIUS = np.array([0.2, -0.1, 0.1]), 0.8
WHITE = (1.0, 1.0, 1.0)
Drawing = Callable[[int, Camera], np.ndarray]


def ball(index: int, camera: Camera, centre: np.ndarray = BALL, radius: float = RADIUS) -> np.ndarray:
    """(H, W) uint8: how much of each pixel a ball covers."""
    fine = Camera(camera.name, 4 * WIDTH, 4 * HEIGHT, camera.model, tuple(4 * number for number in camera.params), camera.world_from_camera)
    origins, directions = (np.asarray(part).reshape(-1, 3) for part in rays(fine))
    along = ((centre - origins) * directions).sum(1)
    distance = np.linalg.norm(origins + along[:, None] * directions - centre, axis=1)
    return np.rint(255 * (distance < radius).reshape(HEIGHT, 4, WIDTH, 4).mean((1, 3))).astype(np.uint8)


def off_centre(index: int, camera: Camera) -> np.ndarray:
    return ball(index, camera, np.array([0.7, 0.4, 0.3]), 0.5)


def but_for_a_thing(index: int, camera: Camera) -> np.ndarray:
    """White but for a disc that moves."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return np.where(np.hypot(x - 6 - 4 * index, y - 12) < 4, np.uint8(0), np.uint8(255))


def wandering(index: int, camera: Camera) -> np.ndarray:
    """A disc here and there, which is no view of one object."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return np.where(np.hypot(x - (5, 27, 14, 8, 25, 18)[index], y - (6, 18, 5, 19, 5, 18)[index]) < 4, np.uint8(255), np.uint8(0))


def lens(index: int, camera: Camera) -> np.ndarray:
    """The round picture of a fisheye lens."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return np.where(np.hypot((x - WIDTH / 2) / 15, (y - HEIGHT / 2) / 11.5) < 1, np.uint8(255), np.uint8(0))


def with_masks(how: str, folder: Path, draw: Drawing) -> Path:
    """A source whose photographs have masks beside them."""
    made = captures.cameras()
    if how == "nerfstudio":
        frames = captures.frames(made)
        for frame in frames:
            frame["mask_path"] = frame["file_path"].replace("images/", "masks/")
        captures.nerfstudio(folder, frames=frames)
    else:
        {"llff": captures.llff, "colmap": captures.colmap_bin}[how](folder)
    for index, camera in enumerate(made):
        captures.write_picture(folder / "masks" / camera.name, draw(index, camera))
    return folder


def with_alpha(how: str, folder: Path, draw: Drawing) -> Path:
    """The same as alpha channels."""
    {"llff": captures.llff, "colmap": captures.colmap_bin, "nerfstudio": captures.nerfstudio}[how](folder)
    for index, camera in enumerate(captures.cameras()):
        path = folder / ("images_4" if how == "llff" else "images") / camera.name
        captures.write_picture(path, np.dstack([captures.picture(index), draw(index, camera)]))
    return folder


def run(source: Path, out: Path, **settings: Any) -> tuple[Scene, list[str], list[str]]:
    """The scene, what was said, and the warnings."""
    events: list[dict[str, Any]] = []
    poses.run(captures.poses_job(source, out, events.append, **settings))
    said, warned = ([event["text"] for event in events if event["event"] == kind] for kind in ("message", "warning"))
    return scene.load(out / "poses"), said, warned


@pytest.mark.parametrize(("how", "write"), [("nerfstudio", with_masks), ("llff", with_alpha), ("colmap", with_masks)])
def test_silhouettes_of_one_object_bound_the_scene(how: str, write: Callable[..., Path], tmp_path: Path) -> None:
    made, said, warned = run(write(how, tmp_path / "source", ball), tmp_path)
    assert made.background == WHITE
    assert made.space == "box"
    assert [text for text in warned if "sparse points" not in text] == []  # the fixture has few of them
    assert any("are silhouettes: " in text for text in said)
    report = json.loads((tmp_path / "poses/report.json").read_text())
    assert {facts["use"] for facts in report["masks"].values()} == {"silhouette"}
    assert report["framing"]["bounds_from"] == "silhouettes"
    corners = made.world_from_capture.inverse().points(np.array([[x, y, z] for x in made.bounds[:, 0] for y in made.bounds[:, 1] for z in made.bounds[:, 2]]))
    assert (corners.min(0) <= BALL - RADIUS).all()
    assert (corners.max(0) >= BALL + RADIUS).all()
    assert 1 / made.world_from_capture.scale < 2.5 * RADIUS
    for index, view in enumerate(made.views):
        assert view.mask is None
        camera = captures.cameras()[index]
        found = scene.read_image(tmp_path / "poses", view)[..., 3].astype(int)
        assert abs(found - ball(index, camera)).max() <= working_images.TRANSPARENT, "soft edges stay"
        assert ((found > 0) & (found < 255)).any()


@pytest.mark.parametrize(("how", "draw"), [("nerfstudio", but_for_a_thing), ("llff", wandering), ("colmap", lens)])
def test_other_masks_leave_pixels_out(how: str, draw: Drawing, tmp_path: Path) -> None:
    made, said, _ = run(with_masks(how, tmp_path / "source", draw), tmp_path)
    assert made.background is None
    assert any(text.startswith("masks leave pixels out: ") for text in said)
    for index, view in enumerate(made.views):
        assert scene.read_image(tmp_path / "poses", view).shape[2] == 3
        np.testing.assert_array_equal(scene.read_mask(tmp_path / "poses", view), draw(index, captures.cameras()[index]) > 0)


def test_masks_and_alpha_are_judged_apart(tmp_path: Path) -> None:
    source = with_alpha("colmap", tmp_path / "source", but_for_a_thing)
    for index, camera in enumerate(captures.cameras()):
        captures.write_picture(source / "masks" / camera.name, ball(index, camera))
    made, said, _ = run(source, tmp_path)
    assert [text.partition(":")[0] for text in said if "silhouette" in text or "leave" in text] == ["alpha channels leave pixels out", "masks are silhouettes"]
    assert made.background == WHITE
    np.testing.assert_array_equal(scene.read_mask(tmp_path / "poses", made.views[1]), but_for_a_thing(1, captures.cameras()[1]) > 0)
    assert scene.read_image(tmp_path / "poses", made.views[1])[0, 0, 3] == 0


def test_points_of_the_background_go(tmp_path: Path) -> None:
    source = with_masks("colmap", tmp_path / "source", lambda index, camera: ball(index, camera, radius=0.5))
    made, _, _ = run(source, tmp_path)
    found = made.world_from_capture.inverse().points(scene.read_points(tmp_path / "poses").xyz)
    distance = np.linalg.norm(found - BALL, axis=1)
    everything = np.linalg.norm(captures.sparse_points() - BALL, axis=1)
    assert distance.max() < 0.7 < everything.max()
    assert (everything < 0.45).sum() <= len(found) < len(everything)


def test_cameras_are_judged_by_the_points_of_the_background_too(tmp_path: Path) -> None:
    """They were found with them: that few lie on the object makes no camera less sure."""
    run(with_masks("colmap", tmp_path / "source", ball), tmp_path)
    judged = json.loads((tmp_path / "poses/verdict.json").read_text())["points"]
    assert judged == len(captures.sparse_points())
    assert len(scene.read_points(tmp_path / "poses").xyz) < judged


@pytest.mark.parametrize(
    ("levels", "suffix", "expected"),
    [
        ((0, 1), "png", (0, 255)),
        ((0, 40, 90), "png", (0, 255, 255)),
        ((0, 64, 192, 255), "png", (0, 64, 192, 255)),
        ((9, 128, 246), "jpg", (0, 128, 255)),
    ],
)
def test_levels_of_masks(levels: tuple[int, ...], suffix: str, expected: tuple[int, ...], tmp_path: Path) -> None:
    """Labels count as they are; greys are soft."""
    mask = np.repeat(np.repeat(np.array([levels], np.uint8), 64, 0), 64, 1)
    captures.write_picture(tmp_path / f"m.{suffix}", mask)
    camera = Camera("a.png", mask.shape[1], 64, "SIMPLE_PINHOLE", (40.0, 32.0, 32.0), np.eye(4))
    found, warned = working_images.mask_levels(Photo(camera, tmp_path / "a.png", tmp_path / f"m.{suffix}"), 1)
    assert not warned
    assert [int(found[32, 64 * n + 32]) for n in range(len(levels))] == list(expected)
    inverse = working_images.mask_levels(Photo(camera, tmp_path / "a.png", tmp_path / f"m.{suffix}", "white"), 1)[0]
    np.testing.assert_array_equal(inverse, 255 - found)


def photographs_with(folder: Path, draw: Drawing, *, turned: bool) -> Path:
    """Photographs with masks; `turned`: the object turned, before a background that stood still."""
    for index, camera in enumerate(captures.cameras()):
        captures.write_picture(folder / camera.name, captures.picture(0 if turned else index))
        captures.write_picture(folder / "masks" / camera.name, draw(index, camera))
    return folder


class Found:
    """In place of structure from motion: true cameras with the surroundings, the object alone, or both; others are mixed up."""

    def __init__(self, *right: str) -> None:
        self.right, self.asked = right, list[str]()

    def __call__(self, request: Request, **callables: Any) -> Capture:
        folder, masks = request.folder, request.masks
        everywhere = not masks if (folder / "masks").is_dir() else bool(masks) and not any(masks.values())
        self.asked.append("surroundings" if everywhere else "object")
        made = captures.cameras()
        if self.asked[-1] not in self.right:
            poses_of_others = [camera.world_from_camera for camera in (*made[3:], *made[:3])]
            heights = [np.diag([1.0, -1.0, -1.0, 1.0]) if index % 2 else np.eye(4) for index in range(len(made))]
            made = [replace(camera, world_from_camera=turn @ pose) for camera, pose, turn in zip(made, poses_of_others, heights, strict=True)]
        photos = tuple(Photo(camera, folder / camera.name, masks.get(camera.name)) for camera in made)
        return Capture("photographs", photos, None)


@pytest.mark.parametrize(
    ("draw", "turned", "right", "asked"),
    [
        (off_centre, False, ("surroundings",), ["surroundings"]),
        (off_centre, True, ("object",), ["object"]),
        (off_centre, False, ("object",), ["surroundings", "object"]),
        (but_for_a_thing, False, ("object",), ["object"]),
    ],
)
def test_features_outside_of_silhouettes(
    draw: Drawing, turned: bool, right: tuple[str, ...], asked: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They count where the background moves with the object, and not where the silhouettes contradict what they tell, nor for other masks."""
    find = Found(*right)
    monkeypatch.setattr("stages.masking.photographs.find_cameras", find)
    made, said, _ = run(photographs_with(tmp_path / "source", draw, turned=turned), tmp_path)
    assert find.asked == asked
    if draw is off_centre:
        assert (made.background, made.space) == (WHITE, "box")
        assert any(text.startswith("masks are silhouettes: 6 of 6 photographs keep one object") for text in said)
    else:
        assert made.background is None
        assert all(view.mask is not None for view in made.views)


def test_masks_that_show_the_object_in_black_are_turned_round_and_said(tmp_path: Path) -> None:
    """The same scene, byte for byte but for what its report says."""
    made, said, _ = run(with_masks("colmap", tmp_path / "source", lambda index, camera: 255 - ball(index, camera)), tmp_path / "black")
    usual, as_ever, _ = run(with_masks("colmap", tmp_path / "usual", ball), tmp_path / "white")
    assert any(text.startswith("masks keep what is black") for text in said)
    assert not any("black" in text for text in as_ever)
    assert made.background == usual.background == WHITE
    np.testing.assert_array_equal(made.bounds, usual.bounds)
    for one, other in zip(made.views, usual.views, strict=True):
        np.testing.assert_array_equal(scene.read_image(tmp_path / "black/poses", one), scene.read_image(tmp_path / "white/poses", other))
