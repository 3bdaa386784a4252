"""Forward-facing captures: which are, the reference camera and box of those that are, the spiral before them; and LLFF captures from all around."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from efficientnerf.asset.camera_paths import spiral_poses
from efficientnerf.capture.forward_facing import detect_forward_facing, mean_pose
from efficientnerf.geometry.cameras import Camera, Similarity
from pipeline.errors import BadInput
from stages.formats import importers
from stages.framing.near_planes import content_depths
from stages.framing.training_frame import find_training_frame
from stages.io.capture import Capture, Photo, SparsePoints
from tests.stages import captures
from tests.stages.forward_facing import FAR, NEAR, depths, looking, row, some_rotation


def in_pictures(cameras: list[Camera], near: float, far: float) -> np.ndarray:
    """Points at depths from near to far of random pixels of the cameras."""
    from efficientnerf.geometry.cameras import rays

    rng = np.random.default_rng(1)
    points = []
    for camera in cameras:
        origins, directions = rays(camera, rng.uniform(0, 1, (200, 2)) * [camera.width, camera.height])
        depth = np.exp(rng.uniform(np.log(near), np.log(far), 200))
        points.append(origins + directions * (depth / (directions @ camera.forward))[:, None])
    return np.concatenate(points)


def test_all_that_the_pictures_show_lies_in_the_box() -> None:
    cameras = row()
    found = detect_forward_facing(cameras, depths(cameras))
    assert not isinstance(found, str), found
    at = found.ndc.points(in_pictures(cameras, NEAR, 1e6))
    assert (at >= found.bounds[0]).all()
    assert (at <= found.bounds[1]).all()
    assert found.bounds[0, 2] == -1
    assert found.bounds[1, 2] == 1
    # Not much of it is empty: the near plane is not far before the content, the sides lie at it.
    assert 0.6 * NEAR < found.ndc.near < NEAR
    assert at[:, :2].max() > 0.8 * found.bounds[1, :2].max()
    assert found.far == pytest.approx(1.2 * FAR, rel=0.05)


def test_a_voxel_is_a_pixel_wide_and_a_pixel_of_parallax_deep() -> None:
    cameras = row(spread=1.0)
    found = detect_forward_facing(cameras, depths(cameras))
    assert not isinstance(found, str), found
    centres = np.array([camera.centre for camera in cameras])
    baseline = np.ptp((centres - mean_pose(cameras)[:3, 3]) @ mean_pose(cameras)[:3, :2], axis=0).max()
    focal = cameras[0].intrinsics["fx"]
    z = 2 * found.ndc.near
    step = found.ndc.slopes[0] / focal  # a pixel to the side
    deeper = found.ndc.world(np.array([0, 0, 1 - 2 * found.ndc.near / z + step]))
    depth = (deeper - found.ndc.world_from_camera[:3, 3]) @ found.ndc.world_from_camera[:3, 2]
    assert focal * baseline * (1 / z - 1 / depth) == pytest.approx(1, rel=1e-6)


def capture(cameras: list[Camera], kind: str = "llff", **more: object) -> Capture:
    moved = Similarity(3.0, some_rotation(2), np.array([5.0, -2.0, 1.0]))
    photos = tuple(Photo(moved.camera(camera), Path("a.png"), near=3 * NEAR, far=3 * FAR) for camera in cameras)
    return Capture(kind, photos, None, **more)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["photographs", "llff", "colmap"])
def test_the_space_follows_the_cameras_and_the_setting(kind: str) -> None:
    forward, ring = row(), captures.cameras(8)
    assert find_training_frame(capture(forward, kind)).space == "ndc"
    assert find_training_frame(capture(ring, kind)).space == "contracted"
    wide = find_training_frame(capture(row(spread=6.0), kind))
    assert wide.space == ("ndc" if kind == "llff" else "contracted"), wide.facts
    assert find_training_frame(capture(forward), space="box").space == "box"
    assert find_training_frame(capture(forward), space="contracted").forward is None
    assert find_training_frame(replace(capture(forward), background=(1.0, 1.0, 1.0))).space == "box"
    with pytest.raises(BadInput, match=r"poses\.space"):
        find_training_frame(capture(ring), space="ndc")


def test_the_reference_camera_is_in_the_training_frame() -> None:
    found = find_training_frame(capture(row()))
    there = [found.world_from_capture.camera(photo.camera) for photo in capture(row()).photos]
    np.testing.assert_allclose(found.forward.ndc.world_from_camera, mean_pose(there), atol=1e-9)
    points = found.world_from_capture.points(Similarity(3.0, some_rotation(2), np.array([5.0, -2.0, 1.0])).points(in_pictures(row(), NEAR, FAR)))
    at = found.forward.ndc.points(points)
    assert (at >= found.forward.bounds[0]).all()
    assert (at <= found.forward.bounds[1]).all()


def test_depths_come_from_sparse_points_where_the_source_states_none() -> None:
    cameras = row()
    points = in_pictures(cameras, NEAR, FAR)
    photos = tuple(Photo(camera, Path("a.png")) for camera in cameras)
    sparse = SparsePoints(points, np.zeros((len(points), 3), np.uint8), np.full(len(points), 0.5), ((0, 1, 2),) * len(points))
    shown, world = Capture("llff", photos, None, points=sparse), Similarity(1.0, np.eye(3), np.zeros(3))
    found = content_depths(shown, cameras, world)
    assert (found[:, 0] >= NEAR).all()
    assert (found[:, 0] < 1.3 * NEAR).all()
    assert (found[:, 1] > 0.8 * FAR).all()
    assert np.isnan(content_depths(replace(shown, points=None), cameras, world)).all()
    stated = replace(shown, photos=tuple(replace(photo, near=2.0, far=5.0) for photo in photos))
    assert (content_depths(stated, cameras, Similarity(0.5, np.eye(3), np.zeros(3))) == [1.0, 2.5]).all()


def test_the_spiral_stays_among_the_cameras_and_looks_at_one_point() -> None:
    middle, radii, focus = mean_pose(row()), (0.8, 0.4, 0.1), 7.0
    poses = spiral_poses(middle, radii, focus, 60)
    places = np.array([pose[:3, 3] for pose in poses])
    local = (places - middle[:3, 3]) @ middle[:3, :3]
    np.testing.assert_allclose(np.abs(local).max(0), radii, rtol=0.02)
    np.testing.assert_allclose((local[:, 0] / 0.8) ** 2 + (local[:, 1] / 0.4) ** 2, 1)
    assert np.abs(np.diff(np.unwrap(np.arctan2(local[:, 1] / 0.4, local[:, 0] / 0.8)))).sum() == pytest.approx(2 * 2 * np.pi * 59 / 60)
    target = middle[:3, 3] + focus * middle[:3, 2]
    for pose in poses:
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) > 0
        away = target - pose[:3, 3]
        np.testing.assert_allclose(np.cross(away / np.linalg.norm(away), pose[:3, 2]), 0, atol=1e-12)
        assert pose[:3, 1] @ middle[:3, 1] > 0.9  # upright


def around(count: int = 12) -> list[Camera]:
    """Cameras of captures.py's pictures on two rings about a place off the origin, looking inwards: near 2, far 7 hold a subject of radius 1."""
    made = []
    target = np.array([10.0, -3.0, 2.0])
    for k in range(count):
        angle, height = 2 * np.pi * k / count, (1.0, 2.5)[k % 2]
        camera = looking(target + np.array([4 * np.cos(angle), 4 * np.sin(angle), height]), target, focal=1.25, name=f"img_{k:02d}.png")
        params = (captures.FOCAL, captures.WIDTH / 2, captures.HEIGHT / 2)
        made.append(replace(camera, width=captures.WIDTH, height=captures.HEIGHT, params=params))
    return made


def test_llff_captures_from_all_around_are_centred_on_what_they_look_at(tmp_path: Path) -> None:
    """What LLFF's spherify does, from poses_bounds.npy on: recentred, upright, a box round the subject, an orbit about it."""
    turn = some_rotation(7)
    cameras = [Similarity(1.0, turn, np.zeros(3)).camera(camera) for camera in around()]
    folder = captures.llff(tmp_path / "a", cameras)
    read = importers.IMPORTERS["llff"].read(folder, captures.Settings())
    found = find_training_frame(read)
    assert found.space == "contracted"
    assert found.forward is None
    subject = turn @ np.array([10.0, -3.0, 2.0])
    there = found.world_from_capture.points(subject)
    unit = found.world_from_capture.scale
    assert np.linalg.norm(there) < unit  # the origin of the training frame is in the subject
    np.testing.assert_allclose(found.world_from_capture.rotation @ turn @ [0, 0, 1], [0, 0, 1], atol=0.05)
    ball = there + unit * np.stack([*np.eye(3), *-np.eye(3)]) * 0.9
    assert (ball >= found.bounds[0]).all()
    assert (ball <= found.bounds[1]).all()
    assert (found.bounds[1] - found.bounds[0]).max() < 6 * unit  # not the whole of near to far
    assert not found.orbit.forward_facing
    assert found.orbit.radius == pytest.approx(4.3 * unit, rel=0.1)
    assert (found.near_far_planes[:, 0] < found.near_far_planes[:, 1]).all()
