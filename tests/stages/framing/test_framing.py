"""Up, focus, box, near and far: on rigs whose answers are known, and on real captures where they are there."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from efficientnerf.geometry.cameras import Camera, Similarity, project, rays
from efficientnerf.geometry.orbit import rotation_to_z
from pipeline.errors import BadInput
from stages.framing import scene_bounds
from stages.framing.training_frame import TrainingFrame, estimated_up, find_training_frame
from stages.io.capture import Capture, Photo, SparsePoints
from tests.stages.forward_facing import looking, some_rotation

PLAIN = Path("a.png")


def ring(count: int, radius: float, height: float, target: np.ndarray, *, arc: float = 360.0, start: float = 0.0, roll: float = 0.0) -> list[Camera]:
    rng = np.random.default_rng(1)
    cameras = []
    for i in range(count):
        angle = np.radians(start + arc * i / (count if arc >= 360 else max(count - 1, 1)))
        centre = target + np.array([radius * np.cos(angle), radius * np.sin(angle), height])
        aim = target + rng.normal(0, 0.02 * radius, 3)
        cameras.append(looking(centre, aim, roll=roll * rng.normal(), name=f"{i:03d}"))
    return cameras


def capture_of(cameras: list[Camera], xyz: np.ndarray | None = None, *, moved: Similarity | None = None, **more: object) -> Capture:
    """A capture in a frame of its own: `moved` takes the rig there; every camera observes the points it has in view."""
    moved = moved or Similarity.identity()
    points = None
    if xyz is not None:
        seen = scene_bounds.in_view(xyz, cameras)
        count = len(xyz)
        tracks = tuple(tuple(int(i) for i in np.flatnonzero(seen[:, k])) for k in range(count))
        points = SparsePoints(moved.points(xyz), np.zeros((count, 3), np.uint8), np.ones(count), tracks)
    photos = tuple(Photo(moved.camera(camera), PLAIN) for camera in cameras)
    return Capture("photographs", photos, None, points=points, **more)  # type: ignore[arg-type]


def scene_points(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A subject (a block 0.6 x 0.4 x 0.5 on z = 0), and a wall all round at eight times its size."""
    rng = np.random.default_rng(seed)
    subject = rng.uniform([-0.3, -0.2, 0.0], [0.3, 0.2, 0.5], (600, 3))
    angle = rng.uniform(0, 2 * np.pi, 600)
    wall = np.stack([5 * np.cos(angle), 5 * np.sin(angle), rng.uniform(-0.5, 2.5, 600)], -1)
    return subject, wall


def check_laws(capture: Capture, framed: TrainingFrame) -> None:
    """What holds for every framing."""
    np.testing.assert_allclose(framed.bounds[0], -framed.bounds[1], atol=1e-12)
    assert framed.bounds[1].max() == pytest.approx(1.0)
    assert (framed.bounds[1] > 0).all()
    rotation = framed.world_from_capture.rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert framed.near_far_planes.shape == (len(capture.photos), 2)
    assert (framed.near_far_planes[:, 0] > 0).all()
    assert (framed.near_far_planes[:, 1] > framed.near_far_planes[:, 0]).all()
    centre = np.array(framed.orbit.centre)
    assert (centre >= framed.bounds[0] - 1e-12).all()
    assert (centre <= framed.bounds[1] + 1e-12).all()


# -------------------------------------------------------------------------------------------------------------------- up


@pytest.mark.parametrize(("seed", "arc"), [(0, 360.0), (1, 150.0), (2, 40.0), (3, 40.0)])
def test_up_is_found_from_level_cameras(seed: int, arc: float) -> None:
    cameras = ring(24, 2.0, 1.0, np.zeros(3), arc=arc, roll=0.01)
    rotation = some_rotation(seed)
    moved = Similarity(3.0, rotation, np.array([1.0, 2.0, 3.0]))
    found = estimated_up([moved.camera(camera) for camera in cameras])
    assert np.degrees(np.arccos(found @ rotation[:, 2])) < (1.0 if arc > 100 else 10.0)


@pytest.mark.parametrize("up", [[0, 0, 1], [0, 0, -1], [0.1, -0.9, 0.2]])
def test_rotation_to_z(up: list[float]) -> None:
    unit = np.array(up) / np.linalg.norm(up)
    rotation = rotation_to_z(unit)
    np.testing.assert_allclose(rotation @ unit, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_stated_up_keeps_the_axes() -> None:
    subject, _ = scene_points()
    capture = capture_of(ring(12, 2, 1, np.zeros(3), arc=100), subject, up=np.array([0.0, 0.0, 1.0]))
    framed = find_training_frame(capture)
    np.testing.assert_array_equal(framed.world_from_capture.rotation, np.eye(3))
    assert find_training_frame(capture, up="-y").facts["up"] == [0.0, -1.0, 0.0]
    np.testing.assert_allclose(find_training_frame(capture, up="-y").world_from_capture.rotation @ [0, -1, 0], [0, 0, 1], atol=1e-12)


# ------------------------------------------------------------------------------------------------------------------- box


@pytest.mark.parametrize(("seed", "arc"), [(0, 360.0), (1, 170.0), (2, 360.0)])
def test_box_holds_the_subject_and_not_the_room(seed: int, arc: float) -> None:
    subject, wall = scene_points(seed)
    cameras = ring(30, 1.6, 0.8, np.array([0, 0, 0.2]), arc=arc)
    moved = Similarity(2.5, some_rotation(seed), np.array([4.0, -1.0, 2.0]))
    capture = capture_of(cameras, np.concatenate([subject, wall]), moved=moved)
    framed = find_training_frame(capture)
    check_laws(capture, framed)
    inside = framed.world_from_capture.points(moved.points(subject))
    assert (np.abs(inside) <= framed.bounds[1] * 1.01).mean() > 0.99
    half = framed.bounds[1] / framed.world_from_capture.scale / 2.5
    assert half.max() < 0.5  # the block's half diagonal is 0.36, the room's radius 5
    assert framed.orbit.forward_facing == (arc < 180)
    assert framed.orbit.elevation == pytest.approx(26, abs=8)
    upward = framed.world_from_capture.rotation @ moved.rotation[:, 2]
    assert upward[2] > np.cos(np.radians(2.0))


def test_given_box_wins_and_is_kept_exactly() -> None:
    subject, wall = scene_points()
    capture = capture_of(ring(20, 1.6, 0.8, np.zeros(3)), np.concatenate([subject, wall]), up=np.array([0.0, 0.0, 1.0]))
    framed = find_training_frame(capture, box=(-1.0, -0.5, 0.0, 1.0, 0.5, 0.25))
    check_laws(capture, framed)
    np.testing.assert_allclose(framed.world_from_capture.inverse().points(framed.bounds), [[-1, -0.5, 0], [1, 0.5, 0.25]], atol=1e-12)
    stated = find_training_frame(Capture(capture.kind, capture.photos, None, up=capture.up, bounds=np.array([[-1.0, -1, -1], [1, 1, 1]])))
    np.testing.assert_allclose(stated.bounds, [[-1, -1, -1], [1, 1, 1]], atol=1e-12)
    for wrong in ((0, 0, 0, 1, 1), (0, 0, 0, 1, 1, 0), (0, 0, 0, 1, 1, np.nan)):
        with pytest.raises(BadInput, match="crop box"):
            find_training_frame(capture, box=wrong)


@pytest.mark.parametrize("with_alpha", [True, False])
def test_box_without_points(tmp_path: Path, with_alpha: bool) -> None:
    """A ball of radius 0.4 off the centre, drawn as alpha; without alpha the box is what the cameras see together."""
    ball = np.array([0.2, -0.1, 0.3])
    cameras = ring(24, 3.0, 1.5, np.array([0.0, 0.0, 0.2])) + ring(12, 2.0, 2.6, np.array([0.0, 0.0, 0.2]))
    photos = []
    for index, camera in enumerate(cameras):
        pixels, depth = project(camera, ball[None])
        y, x = np.mgrid[:75, :100] + 0.5
        # the outline of a ball is an ellipse; a disc a little larger than it serves
        opaque = np.hypot(x - pixels[0, 0], y - pixels[0, 1]) <= 1.05 * camera.params[0] * 0.4 / np.sqrt(depth[0] ** 2 - 0.4**2)
        rgba = np.full((75, 100, 4), 200, np.uint8)
        rgba[..., 3] = np.where(opaque, 255, 0) if with_alpha else 255
        Image.fromarray(rgba).save(tmp_path / f"{index}.png")
        photos.append(Photo(camera, tmp_path / f"{index}.png", split="train"))
    capture = Capture("blender", tuple(photos), (1.0, 1.0, 1.0), up=np.array([0.0, 0.0, 1.0]))
    framed = find_training_frame(capture)
    check_laws(capture, framed)
    corners = framed.world_from_capture.inverse().points(framed.bounds)
    assert (corners[0] <= ball - 0.4).all()
    assert (corners[1] >= ball + 0.4).all()
    half = framed.bounds[1] / framed.world_from_capture.scale
    assert half.max() < (0.65 if with_alpha else 2.0)
    # depths: the whole box, nothing else
    for camera, (near, far) in zip(cameras, framed.near_far_planes, strict=True):
        corner_depth = (framed.bounds[1] - framed.world_from_capture.camera(camera).centre) @ framed.world_from_capture.camera(camera).forward
        assert near - 1e-9 <= corner_depth <= far + 1e-9


# --------------------------------------------------------------------------------------------------------------- silhouettes


def ellipsoids(kind: str) -> list[tuple[list[float], list[float]]]:
    """Centres and radii of a head of radius 0.45, and of what it wears."""
    ears = [([side * 0.25, 0.0, 0.6], [0.08, 0.05, 0.35]) for side in (-1, 1)]
    horns = [([side * 0.75, 0.0, 0.3], [0.45, 0.06, 0.06]) for side in (-1, 1)]
    nose = ([0.0, -0.6, -0.05], [0.08, 0.25, 0.08])
    return [([0.0, 0.0, 0.0], [0.45, 0.45, 0.45]), nose, *{"ears": ears, "horns": horns}[kind]]


def outlines(kind: str, camera: Camera) -> np.ndarray:
    """(h, w) bool: which pixels show the ellipsoids."""
    origins, directions = rays(camera)
    out = np.zeros(len(origins), bool)
    for centre, radii in ellipsoids(kind):
        away, along = (origins - centre) / radii, directions / radii
        half, square = (away * along).sum(1), (along**2).sum(1)
        out |= (half**2 >= square * ((away**2).sum(1) - 1)) & (half < 0)
    return out.reshape(camera.height, camera.width)


def near_and_far(seed: int, far: float, close: float, arc: float) -> list[Camera]:
    """48 cameras round the head, so many of them from far, and the others so close that they have little but the face in view."""
    generator = np.random.default_rng(seed)
    cameras = []
    for number in range(48):
        angle = np.radians(-90 + arc * ((number * 17 % 48 + 0.5) / 48 - 0.5))
        distance = 4.0 if number < 48 * far else close
        height = 0.3 * distance * generator.uniform(-0.5, 1)
        centre = np.array([distance * np.cos(angle), distance * np.sin(angle), height])
        cameras.append(looking(centre, 0.04 * distance * generator.normal(size=3), name=f"{number:03d}"))
    return cameras


def shares_outside(pictures: list[np.ndarray], cameras: list[Camera], low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return scene_bounds.shares_outside(pictures, scene_bounds.silhouettes_outside(pictures, cameras, low, high))


@pytest.mark.parametrize(
    ("kind", "far", "close", "arc"),
    [("ears", 0.3, 1.3, 360), ("horns", 0.3, 1.6, 360), ("horns", 1.0, 1.0, 360), ("ears", 0.6, 1.3, 150)],
)
def test_what_three_photographs_show_is_in_the_box_of_silhouettes(kind: str, far: float, close: float, arc: float) -> None:
    cameras = near_and_far(4, far, close, arc)
    pictures = [outlines(kind, camera) for camera in cameras]
    hull = scene_bounds.whole_visual_hull(pictures, cameras, [(None, None)] * len(cameras), np.zeros(3), True)
    assert hull is not None
    low, high = scene_bounds.box_round(*hull)
    assert (shares_outside(pictures, cameras, low, high) > scene_bounds.MAX_OUTSIDE).sum() < 3
    directions = np.random.default_rng(0).normal(size=(500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    surface = np.concatenate([np.asarray(centre) + directions * radii for centre, radii in ellipsoids(kind)])
    shown = scene_bounds.in_view(surface, cameras).sum(0) >= 3
    step = hull[1]
    assert (surface[shown] >= low - 0.5 * step).all()
    assert (surface[shown] <= high + 0.5 * step).all()
    if arc == 360:  # from one side what is behind is not carved
        assert (high - low).prod() <= 4 * np.ptp(surface[shown], axis=0).prod()
