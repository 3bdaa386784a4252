"""Turntables see the whole box upright; nerfstudio's paths mean what they meant there; what is wrong with a path is said."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.asset.camera_paths import orbit_of, pose_on_sphere, similarity_of, turntable_cameras
from efficientnerf.asset.captured import MetadataError, captured_metadata, captured_of
from efficientnerf.asset.rendering import MOST_PIXELS
from efficientnerf.asset.tree import NerfTree, Region
from efficientnerf.geometry.cameras import Camera, Similarity, opengl_from_pose, project
from pipeline.errors import BadInput
from stages.io.camera_path import read_camera_path
from tests.efficientnerf.trees import random_cascades, random_tree
from tests.efficientnerf.walls import wall
from tests.fakes import BallTree

ROTATION = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
SIMILARITY = Similarity(0.5, ROTATION, np.array([0.1, 0.2, 0.3]))


def on_the_ball(tree: BallTree) -> np.ndarray:
    away = np.random.default_rng(0).normal(size=(2000, 3))
    return tree.centre + tree.radius * away / np.linalg.norm(away, axis=1, keepdims=True)


@pytest.mark.parametrize(("azimuth", "elevation"), [(0.0, -90.0), (37.0, -20.0), (200.0, 90.0)])
def test_pose_is_a_rotation_that_looks_at_the_centre_and_stands_upright(azimuth: float, elevation: float) -> None:
    centre = np.array([1.0, -2.0, 0.5])
    pose = pose_on_sphere(tuple(centre), 3.0, azimuth, elevation)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(pose[:3, 3] + 3.0 * pose[:3, 2], centre, atol=1e-12)
    assert pose[2, 0] == pytest.approx(0.0)  # the horizon is level
    assert pose[2, 1] <= 1e-12  # down is down
    assert math.degrees(math.asin((pose[2, 3] - centre[2]) / 3.0)) == pytest.approx(elevation, abs=1e-5)


class UprightTree(BallTree):
    @property
    def metadata(self) -> dict[str, Any]:
        return {**super().metadata, "up": [0.48, 0.6, 0.64]}


@pytest.mark.parametrize("similarity", [Similarity.identity(), SIMILARITY])
def test_turntables_are_level_by_an_up_that_was_set(similarity: Similarity) -> None:
    whole = UprightTree(centre=(0.3, 0.2, 0.1), radius=0.3, similarity=similarity)
    true = similarity.rotation @ [0.48, 0.6, 0.64]
    cameras = turntable_cameras(whole, frames=8, width=64, height=48)
    assert max(abs(camera.world_from_camera[:3, 0] @ true) for camera in cameras) < 1e-9
    heights = [camera.centre @ true for camera in cameras]
    assert np.ptp(heights) < 1e-9
    seen = np.stack([project(camera, on_the_ball(whole))[0] for camera in cameras]) / (64, 48)
    assert (seen.min() > 0, seen.max() < 1) == (True, True)


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


def test_an_asset_without_an_orbit_gets_one_and_a_broken_one_is_refused() -> None:
    class Bare(BallTree):
        metadata: dict[str, Any] = {}  # noqa: RUF012

    assert orbit_of(Bare()).radius > 3.0
    assert similarity_of(Bare()).scale == 1.0
    Bare.metadata = {"orbit": {"centre": [0, 0], "radius": 1}}
    with pytest.raises(MetadataError):
        orbit_of(Bare())
    Bare.metadata = {"world_from_capture": {"scale": -1, "rotation": np.eye(3).tolist(), "translation": [0, 0, 0]}}
    with pytest.raises(MetadataError):
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


IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"camera_path": None}, "camera_path"),
        ({"camera_path": []}, "0 cameras"),
        ({"camera_path": [3]}, r"camera_path\[0\]"),
        ({"camera_type": "fisheye"}, "perspective"),
        ({"camera_to_world": None}, "16 finite numbers"),
        ({"camera_to_world": [1.0] * 12}, "12"),
        ({"camera_to_world": [*IDENTITY[:15], "1"]}, "16 finite numbers"),
        ({"camera_to_world": [*IDENTITY[:3], 10**400, *IDENTITY[4:]]}, "finite"),
        ({"camera_to_world": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1]}, "transposed"),
        ({"camera_to_world": [-1, *IDENTITY[1:]]}, "left-handed"),
        ({"fov": 0}, "fov"),
        ({"fov": True}, "fov"),
        ({"render_width": 10.5}, "render_width"),
        ({"render_width": 16384, "render_height": 16384}, f"{MOST_PIXELS} pixels"),
        ({"render_height": 1e9}, "render_height"),
        ({"fps": "fast"}, "fps"),
    ],
)
def test_what_is_wrong_with_a_path_is_said(tmp_path: Path, changes: dict[str, Any], named: str) -> None:
    path = path_file(tmp_path, **changes)
    with pytest.raises(BadInput, match=named) as caught:
        read_camera_path(path, SIMILARITY)
    assert str(path) in str(caught.value)


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
        except MetadataError:
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
        except MetadataError:
            continue
        assert np.isfinite([camera.world_from_camera for camera in cameras]).all()


def arc(degrees: float, *, count: int = 20, distance: float = 3.0, target: tuple[float, float, float] = (0.0, 0.0, 0.0), rise: float = 10.0) -> list[Camera]:
    angles = np.linspace(-90 - degrees / 2, -90 + degrees / 2, count, endpoint=degrees < 360)
    heights = 20 + rise * np.sin(np.arange(count) * 2.1)
    poses = [pose_on_sphere(target, distance, a, e) for a, e in zip(angles, heights, strict=True)]
    return [Camera("", 120, 90, "SIMPLE_PINHOLE", (110.0, 60, 45), pose) for pose in poses]


def captured_tree(degrees: float, **more: Any) -> NerfTree:
    """Voxels throughout two nested grids, whose subject is aside."""
    tree = random_cascades(5, share=0.9)
    low, high = tree.bounds_min, tree.bounds_max
    around = Region(np.stack([low + 0.5 * (high - low), high]))
    metadata = {"captured_path": captured_metadata(arc(degrees, target=tuple(around.bounds.mean(axis=0)), **more))}
    return replace(tree, region=around, metadata=metadata)


@pytest.mark.parametrize(("degrees", "size"), [(360.0, (64, 48)), (120.0, (48, 64)), (40.0, (48, 64))])
def test_the_whole_region_is_in_the_middle_of_every_picture(degrees: float, size: tuple[int, int]) -> None:
    tree = captured_tree(degrees)
    cameras = turntable_cameras(tree, frames=16, width=size[0], height=size[1])
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    points = tree.region.bounds[0] + (0.1 + 0.8 * corners) * (tree.region.bounds[1] - tree.region.bounds[0])
    seen = np.stack([project(camera, points)[0] for camera in cameras]) / size
    assert seen.min() > 0
    assert seen.max() < 1
    middle = np.stack([project(camera, tree.region.bounds.mean(axis=0)[None])[0][0] for camera in cameras]) / size
    assert np.abs(middle - 0.5).max() < 0.1
    assert all(abs(camera.world_from_camera[2, 0]) < 1e-9 for camera in cameras), "upright"
    distances = [np.linalg.norm(camera.centre - tree.region.bounds.mean(axis=0)) for camera in cameras]
    assert min(distances) >= 0.97 * 3.0, "not closer than the photographs"


def test_a_region_beyond_the_inmost_cascade_is_framed_as_far_as_that_reaches() -> None:
    """As where it takes in a table and the floor round it."""
    tree = captured_tree(360.0)
    inmost = np.stack([tree.bounds_min, tree.bounds_max])
    wide = replace(tree, region=Region(2 * inmost - inmost.mean(axis=0)))
    found, expected = (turntable_cameras(replace(wide, region=Region(box)), frames=4, width=64, height=48) for box in (wide.region.bounds, inmost))
    for camera, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(camera.world_from_camera, other.world_from_camera)
        np.testing.assert_allclose(camera.params, other.params)


def azimuth_of(camera: Camera) -> float:
    return math.degrees(math.atan2(-camera.forward[1], -camera.forward[0]))


def test_paths_by_name_and_by_hand() -> None:
    tree = captured_tree(100.0)
    around = [azimuth_of(camera) for camera in turntable_cameras(tree, frames=12, width=64, height=48, path="orbit")]
    assert np.ptp(np.degrees(np.unwrap(np.radians(around)))) == pytest.approx(330, abs=1)
    swayed = [(azimuth_of(camera) + 90) % 360 for camera in turntable_cameras(tree, frames=40, width=64, height=48, sway=7.0)]
    assert max(min(a, 360 - a) for a in swayed) == pytest.approx(7, abs=0.1)
    captured = turntable_cameras(tree, frames=30, width=64, height=48, path="captured")
    places = np.array([camera.centre for camera in captured])
    assert np.linalg.norm(places - tree.region.bounds.mean(axis=0), axis=1) == pytest.approx(3.0, rel=0.05)
    assert captured[0].params[0] == pytest.approx(110.0 * 80 / 150, rel=1e-3)  # by the diagonal
    assert turntable_cameras(tree, frames=1, width=64, height=48, path="captured", fov=90.0)[0].params[0] == pytest.approx(24)


def test_captured_cameras_that_cannot_be_are_refused() -> None:
    upright = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]
    wrong: list[Any] = [[], [[0.0] * 12], [[1.0] * 11], [[*upright[:11], math.nan]], [[*upright[:10], -1, 0]], [[1, 0, 0, 1e300, *upright[4:]]], "x"]
    stated = captured_metadata(arc(90.0))
    for change in [{"poses": poses} for poses in [*wrong, [upright] * 65]] + [{"focal": 0}, {"width": -3}, {"height": None}, {"focal": math.inf}]:
        with pytest.raises(MetadataError, match="captured_path"):
            captured_of({"captured_path": stated | change})
    with pytest.raises(MetadataError, match="captured_path"):
        captured_of({"captured_path": 7})
    found = captured_of({"captured_path": json.loads(json.dumps(captured_metadata(arc(360.0, count=150))))})
    assert len(found.poses) == 64
