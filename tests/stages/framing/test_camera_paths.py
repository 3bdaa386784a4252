"""Turntables see the whole box upright; nerfstudio's paths mean what they meant there; what is wrong with a path is said."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from efficientnerf.asset.rendering import MOST_PIXELS
from efficientnerf.geometry.cameras import Similarity, opengl_from_pose, project
from pipeline.errors import BadInput, UsageError
from stages.figures.frames import RenderOptions, render_path
from stages.framing.camera_paths import orbit_of, pose_on_sphere, similarity_of, turntable_cameras
from stages.io.camera_path import read_camera_path
from stages.io.png import read_png
from tests.efficientnerf.trees import random_tree
from tests.efficientnerf.walls import wall
from tests.fakes import BallTree

ROTATION = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
SIMILARITY = Similarity(0.5, ROTATION, np.array([0.1, 0.2, 0.3]))


def on_the_ball(tree: BallTree) -> np.ndarray:
    away = np.random.default_rng(0).normal(size=(2000, 3))
    return tree.centre + tree.radius * away / np.linalg.norm(away, axis=1, keepdims=True)


@pytest.mark.parametrize("azimuth", [0.0, 37.0, 200.0])
@pytest.mark.parametrize("elevation", [-90.0, -20.0, 0.0, 45.0, 90.0])
def test_pose_is_a_rotation_that_looks_at_the_centre_and_stands_upright(azimuth: float, elevation: float) -> None:
    centre = np.array([1.0, -2.0, 0.5])
    pose = pose_on_sphere(tuple(centre), 3.0, azimuth, elevation)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(pose[:3, 3] + 3.0 * pose[:3, 2], centre, atol=1e-12)
    assert pose[2, 0] == pytest.approx(0.0)  # the horizon is level
    assert pose[2, 1] <= 1e-12  # down is down
    assert math.degrees(math.asin((pose[2, 3] - centre[2]) / 3.0)) == pytest.approx(elevation, abs=1e-5)


@pytest.mark.parametrize("tree", [BallTree(), BallTree(centre=(0.3, 0.2, 0.1), radius=0.3), BallTree(voxel=1 / 8, radius=3.5)], ids=["ball", "aside", "larger"])
@pytest.mark.parametrize("size", [(640, 480), (300, 500)])
def test_turntable_shows_the_whole_asset_without_wasting_the_picture(tree: BallTree, size: tuple[int, int]) -> None:
    cameras = turntable_cameras(tree, frames=24, width=size[0], height=size[1])
    assert len(cameras) == 24
    seen = np.stack([project(camera, on_the_ball(tree))[0] for camera in cameras]) / size
    assert seen.min() > 0
    assert seen.max() < 1
    assert np.abs(seen - 0.5).max() > 0.38, "the asset fills the picture one way or the other"
    azimuths = np.unwrap([math.atan2(*camera.centre[1::-1]) for camera in cameras])
    np.testing.assert_allclose(np.degrees(azimuths - azimuths[0]), np.arange(24) * 15.0, atol=1e-6)
    assert math.degrees(azimuths[0]) == pytest.approx(90.0)


@pytest.mark.parametrize("layer", [3, 8, 12])
@pytest.mark.parametrize("forward_facing", [False, True])
def test_what_lies_flat_is_seen_with_as_much_room_above_as_below(layer: int, forward_facing: bool) -> None:
    """A floor at any height of the box, and the picture no wider than it is high: the room at the sides decides nothing."""

    class Floor(BallTree):
        @property
        def brick_index(self) -> np.ndarray:
            index = np.full(self.shape, -1, np.int32)
            index[:, 5:11, layer] = np.arange(16 * 6).reshape(16, 6)
            return index

    tree = Floor(forward_facing=forward_facing)
    cells = np.argwhere(tree.brick_index >= 0)
    points = tree.bounds_min + (cells + 0.5) * tree.brick * tree.voxel
    for size in ((400, 100), (100, 100)):
        cameras = turntable_cameras(tree, frames=12, width=size[0], height=size[1], sway=5.0)
        seen = np.stack([project(camera, points)[0] for camera in cameras]) / size
        above, below = seen[..., 1].min(), 1 - seen[..., 1].max()
        assert above == pytest.approx(below, abs=0.01)
        assert 0 < min(above, seen[..., 0].min(), 1 - seen[..., 0].max()) < 0.06, "and fills it one way or the other"
        assert {camera.params[2] for camera in cameras} == {cameras[0].params[2]}, "the picture does not sway"
    asked = turntable_cameras(tree, frames=1, width=64, height=48, fov=50.0)[0]
    assert asked.params[1:] == (32, 24)


def test_turntable_of_a_capture_from_one_side_stays_near_the_heading() -> None:
    cameras = turntable_cameras(BallTree(forward_facing=True), frames=20, width=64, height=48, sway=10.0)
    azimuths = np.degrees([math.atan2(*camera.centre[1::-1]) for camera in cameras])
    assert np.abs(azimuths - 90.0).max() == pytest.approx(10.0, abs=0.1)
    steps = np.linalg.norm(np.diff([c.centre for c in [*cameras, cameras[0]]], axis=0), axis=1)
    assert steps.max() < 3 * steps.min(), "the path closes without a jump"


def test_strays_at_the_edge_do_not_shrink_the_subject() -> None:
    class Speckled(BallTree):
        @property
        def brick_index(self) -> np.ndarray:
            index = super().brick_index
            index[0, 0, 0] = index[-1, -1, -1] = index.max() + 1
            return index

    clean, speckled = (turntable_cameras(tree, frames=6, width=64, height=48)[0] for tree in (BallTree(), Speckled()))
    assert speckled.params[0] == pytest.approx(clean.params[0], rel=0.05)


def test_an_empty_asset_has_a_turntable() -> None:
    assert len(turntable_cameras(BallTree(radius=-1.0), frames=3, width=64, height=48)) == 3


def test_turntable_takes_elevation_radius_in_capture_units_and_fov() -> None:
    tree = BallTree(similarity=SIMILARITY)
    camera = turntable_cameras(tree, frames=1, width=64, height=48, elevation=0.0, radius=5.0, fov=60.0)[0]
    np.testing.assert_allclose(camera.centre, [0.0, 2.5, 0.0], atol=1e-12)
    assert 2 * math.degrees(math.atan(24 / camera.params[0])) == pytest.approx(60.0)


def test_an_asset_without_an_orbit_gets_one_and_a_broken_one_is_refused() -> None:
    class Bare(BallTree):
        metadata: dict[str, Any] = {}  # noqa: RUF012

    assert orbit_of(Bare()).radius > 3.0
    assert similarity_of(Bare()).scale == 1.0
    Bare.metadata = {"orbit": {"centre": [0, 0], "radius": 1}}
    with pytest.raises(BadInput, match="centre of three numbers"):
        orbit_of(Bare())
    Bare.metadata = {"world_from_capture": {"scale": -1, "rotation": np.eye(3).tolist(), "translation": [0, 0, 0]}}
    with pytest.raises(BadInput, match="not a similarity"):
        similarity_of(Bare())


def path_file(folder: Path, **changes: Any) -> Path:
    pose = pose_on_sphere((0.0, 0.0, 0.0), 6.0, 20.0, 30.0)
    entry = {"camera_to_world": opengl_from_pose(pose).ravel().tolist(), "fov": 50, "aspect": 1.25}
    document = {"camera_type": "perspective", "render_width": 100, "render_height": 80, "fps": 24, "seconds": 1, "camera_path": [entry, entry]}
    for name, value in changes.items():
        target = entry if name in ("camera_to_world", "fov") else document
        target[name] = value
        if value is None:
            del target[name]
    path = folder / "camera_path.json"
    path.write_text(json.dumps(document))
    return path


def test_nerfstudio_path_is_taken_to_the_training_frame(tmp_path: Path) -> None:
    found = read_camera_path(path_file(tmp_path), SIMILARITY)
    assert found.fps == 24
    assert [camera.name for camera in found.cameras] == ["frame_0000", "frame_0001"]
    camera = found.cameras[0]
    assert (camera.width, camera.height) == (100, 80)
    assert 2 * math.degrees(math.atan(40 / camera.params[0])) == pytest.approx(50.0)
    expected = pose_on_sphere((0.0, 0.0, 0.0), 6.0, 20.0, 30.0)
    np.testing.assert_allclose(camera.world_from_camera, SIMILARITY.pose(expected), atol=1e-9)
    # the capture's origin stays in the middle of the picture
    np.testing.assert_allclose(project(camera, SIMILARITY.points(np.zeros((1, 3))))[0], [[50.0, 40.0]], atol=1e-6)


def test_size_of_a_path_can_be_set(tmp_path: Path) -> None:
    path = path_file(tmp_path)
    for given, expected in [({"width": 50}, (50, 40)), ({"height": 40}, (50, 40)), ({"width": 7, "height": 9}, (7, 9))]:
        camera = read_camera_path(path, SIMILARITY, **given).cameras[0]
        assert (camera.width, camera.height) == expected


IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"camera_path": None}, "no list `camera_path`"),
        ({"camera_path": []}, "holds 0 cameras"),
        ({"camera_path": [3]}, r"camera_path\[0\]: expected an object"),
        ({"camera_path": None, "frames": []}, "looks like a data set"),
        ({"camera_type": "fisheye"}, "only perspective"),
        ({"camera_to_world": None}, "expected 16 numbers, found nothing"),
        ({"camera_to_world": [1.0] * 12}, "found a list of 12"),
        ({"camera_to_world": [*IDENTITY[:15], "1"]}, "expected 16 numbers"),
        ({"camera_to_world": [*IDENTITY[:3], 10**400, *IDENTITY[4:]]}, "not finite"),
        ({"camera_to_world": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1]}, "looks transposed"),
        ({"camera_to_world": [2, *IDENTITY[1:]]}, "no rotation"),
        ({"camera_to_world": [-1, *IDENTITY[1:]]}, "no rotation"),
        ({"fov": 0}, "fov: found 0"),
        ({"fov": None}, "fov: found nothing"),
        ({"fov": True}, "fov: found True"),
        ({"render_width": 0}, "render_width"),
        ({"render_width": 10.5}, "whole number"),
        ({"render_width": 16384, "render_height": 16384}, f"expected at most {MOST_PIXELS} pixels"),
        ({"render_height": 1e9}, "render_height"),
        ({"fps": "fast"}, "fps"),
    ],
)
def test_what_is_wrong_with_a_path_is_said(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    path = path_file(tmp_path, **changes)
    with pytest.raises(BadInput, match=words) as caught:
        read_camera_path(path, SIMILARITY)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"{", b"[1, 2]", b'{"camera_path": NaN}', b"\xff\xfe", b"[" * 100_000])
def test_files_that_are_no_path(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "path.json").write_bytes(content)
    with pytest.raises(BadInput, match=r"path\.json"):
        read_camera_path(tmp_path / "path.json", SIMILARITY)
    with pytest.raises(BadInput, match=r"missing\.json"):
        read_camera_path(tmp_path / "missing.json", SIMILARITY)


def test_a_path_is_drawn(tmp_path: Path) -> None:
    tree = BallTree(similarity=SIMILARITY)
    cameras = read_camera_path(path_file(tmp_path), SIMILARITY, width=40).cameras
    steps: list[tuple[int, int]] = []
    options = RenderOptions(background="transparent", exr="all", video="path.mp4", fps=24)
    written = render_path(tree, cameras, tmp_path / "out", options, lambda done, total: steps.append((done, total)), BallTree.render)
    names = ["frame_0000.png", "frame_0000.exr", "frame_0001.png", "frame_0001.exr", "path.mp4"]
    assert [path.name for path in written] == names
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == sorted(names)
    assert steps == [(0, 2), (1, 2), (2, 2)]
    assert read_png(written[0]).shape == (32, 40, 4)
    with av.open(str(written[-1])) as container:
        first = next(container.decode(video=0)).to_ndarray(format="rgb24")
    assert first[:4, :4].min() > 250, "what is transparent lies on white in the video"


def test_an_unknown_background_is_refused_before_anything_is_drawn(tmp_path: Path) -> None:
    cameras = turntable_cameras(BallTree(), frames=1, width=16, height=16)
    with pytest.raises(UsageError, match="background"):
        render_path(BallTree(), cameras, tmp_path / "out", RenderOptions(background="paper"))
    assert not (tmp_path / "out").exists()


ODD_NUMBERS = [10**400, 1e308, -1e308, 1e-308, 0, -1, 1e31, math.nan, math.inf, "1", [], None, {}, True]


@pytest.mark.parametrize("name", ["radii", "focus", "tangents"])
def test_an_odd_spiral_gives_cameras_or_is_refused(name: str) -> None:
    tree = wall(voxels=12)
    good: dict[str, Any] = {"radii": [0.1, 0.1, 0.1], "focus": 3.0, "tangents": [0.5, 0.5]}
    spirals: list[Any] = [[], 3, "x", {name: {"a": 1}}, {**good, "radii": [0.0, 0.0, 12.0], "focus": 12.0}]
    for odd in ODD_NUMBERS:
        spirals += [{**good, name: odd}, {**good, name: [odd]}, {**good, name: [odd, 0.5, 0.5][: 2 if name == "tangents" else 3]}]
    for spiral in spirals:
        try:
            cameras = turntable_cameras(tree.with_metadata(spiral=spiral), frames=8, width=32, height=24)
        except BadInput:
            continue
        for camera in cameras:
            assert np.isfinite(camera.world_from_camera).all()
            assert np.isfinite(camera.params).all()


@pytest.mark.parametrize("name", ["centre", "radius", "elevation", "heading"])
def test_an_odd_orbit_gives_cameras_or_is_refused(name: str) -> None:
    good: dict[str, Any] = {"centre": [0.0, 0.0, 0.0], "radius": 3.0, "elevation": 20.0, "heading": 0.0, "forward_facing": False}
    for odd in ODD_NUMBERS:
        tree = random_tree(1).with_metadata(orbit={**good, name: [odd, 0.0, 0.0] if name == "centre" else odd})
        try:
            cameras = turntable_cameras(tree, frames=3, width=32, height=24)
        except BadInput:
            continue
        assert np.isfinite([camera.world_from_camera for camera in cameras]).all()
