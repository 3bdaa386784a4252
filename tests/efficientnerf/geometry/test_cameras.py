"""Laws of cameras: projecting and tracing are inverse for every lens, similarities compose, axes convert and back."""

import numpy as np
import pytest

from efficientnerf.geometry.cameras import (
    MODELS,
    POINTS_AT_ONCE,
    Camera,
    Similarity,
    pose_from_colmap,
    pose_from_llff,
    pose_from_opengl,
    project,
    rays,
    resized,
    rotated_clockwise,
)

LENSES = {
    "SIMPLE_PINHOLE": (300.0, 320.0, 240.0),
    "PINHOLE": (300.0, 330.0, 310.0, 260.0),
    "SIMPLE_RADIAL": (600.0, 320.0, 240.0, -0.2),
    "RADIAL": (300.0, 320.0, 240.0, -0.25, 0.06),
    "OPENCV": (500.0, 480.0, 320.0, 240.0, -0.35, 0.12, 0.01, -0.008),
    "FULL_OPENCV": (500.0, 500.0, 320.0, 240.0, 0.4, 0.1, 0.002, -0.003, 0.01, 0.6, 0.2, 0.03),
    "OPENCV_FISHEYE": (250.0, 255.0, 320.0, 240.0, 0.05, -0.01, 0.002, -0.0005),
}


def random_pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return pose_from_colmap(rng.normal(size=4), rng.normal(size=3))


def camera_of(model: str, seed: int = 0) -> Camera:
    return Camera("a.png", 640, 480, model, LENSES[model], random_pose(seed))


@pytest.mark.parametrize("model", MODELS)
def test_project_and_rays_are_inverse(model: str) -> None:
    camera = camera_of(model)
    rng = np.random.default_rng(1)
    pixels = np.concatenate([rng.uniform((0, 0), (640, 480), (500, 2)), [[0.5, 0.5], [639.5, 479.5], [320, 240]]])
    origins, directions = rays(camera, pixels)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-12)
    np.testing.assert_allclose(origins, np.broadcast_to(camera.centre, origins.shape), atol=0)
    distance = rng.uniform(0.1, 100, (len(pixels), 1))
    again, depth = project(camera, origins + distance * directions)
    np.testing.assert_allclose(again, pixels, atol=1e-7)
    np.testing.assert_allclose(depth, distance[:, 0] * (directions @ camera.forward), rtol=1e-9)


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_many_points_project_as_each_does(model: str) -> None:
    camera, points = camera_of(model), np.random.default_rng(3).normal(size=(2 * POINTS_AT_ONCE + 3, 3))
    pixels, depth = project(camera, points)
    for part in (slice(0, 1000), slice(POINTS_AT_ONCE - 500, POINTS_AT_ONCE + 500), slice(-1000, None)):
        own = project(camera, points[part])
        np.testing.assert_allclose(pixels[part], own[0], rtol=1e-12)
        np.testing.assert_allclose(depth[part], own[1], rtol=1e-12)
    assert np.isnan(pixels).any(axis=1).sum() > 1000, "those behind the camera are not seen"


@pytest.mark.parametrize("model", MODELS)
def test_the_model_is_colmaps(model: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    theirs = pycolmap.Camera(model=model, width=640, height=480, params=LENSES[model])
    local = np.concatenate([np.random.default_rng(3).uniform(-0.4, 0.4, (50, 2)), np.ones((50, 1))], -1)
    ours = Camera("a", 640, 480, model, LENSES[model], np.eye(4))
    np.testing.assert_allclose(project(ours, local)[0], np.asarray(theirs.img_from_cam(local)), atol=1e-9)


def test_points_behind_and_beyond_the_fold_are_not_seen() -> None:
    lens = Camera("a", 640, 480, "SIMPLE_RADIAL", (400.0, 320.0, 240.0, -0.2), np.eye(4))
    fold = np.sqrt(1 / 0.6)  # r - 0.2 r^3 is largest there
    pixels, depth = project(lens, np.array([[0.1, 0, -1], [0.99 * fold, 0, 1], [1.01 * fold, 0, 1], [2.2, 0, 1]]))
    assert np.isnan(pixels[0]).all()
    assert depth[0] == -1
    assert np.isfinite(pixels[1]).all()
    assert np.isnan(pixels[2:]).all(), "COLMAP's formula would put (2.2, 0, 1) into the image"
    fisheye = Camera("a", 640, 480, "OPENCV_FISHEYE", (150.0, 150.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0), np.eye(4))
    assert np.isfinite(project(fisheye, np.array([[1.0, 0, -0.2]]))[0]).all(), "a fisheye sees beyond 90 degrees"


def test_pixels_beyond_the_fold_get_the_outermost_ray() -> None:
    lens = Camera("a", 2000, 2000, "SIMPLE_RADIAL", (400.0, 1000.0, 1000.0, -0.2), np.eye(4))
    _, directions = rays(lens, np.array([[0.0, 0.0], [2000.0, 1000.0]]))
    assert np.isfinite(directions).all()
    np.testing.assert_allclose(np.hypot(directions[:, 0], directions[:, 1]) / directions[:, 2], np.sqrt(1 / 0.6), rtol=1e-6)


@pytest.mark.parametrize(("model", "size"), [(model, ((333, 250), (1000, 751))[n % 2]) for n, model in enumerate(MODELS)])
def test_a_resized_camera_sees_the_same_picture(model: str, size: tuple[int, int]) -> None:
    camera = camera_of(model)
    small = resized(camera, *size)
    pixels = np.random.default_rng(4).uniform((0, 0), (640, 480), (100, 2))
    np.testing.assert_allclose(rays(small, pixels * np.array(size) / (640, 480))[1], rays(camera, pixels)[1], atol=1e-10)
    assert small.model == (model if size == (320, 240) else small.model)
    assert resized(camera, 640, 480) is camera


@pytest.mark.parametrize("model", MODELS)
def test_a_quarter_turn_turns_the_picture(model: str) -> None:
    camera = camera_of(model)
    turned = rotated_clockwise(camera)
    pixels = np.random.default_rng(5).uniform((0, 0), (640, 480), (100, 2))
    points = rays(camera, pixels)[0] + rays(camera, pixels)[1]
    assert (turned.width, turned.height) == (480, 640)
    np.testing.assert_allclose(project(turned, points)[0], np.stack([480 - pixels[:, 1], pixels[:, 0]], -1), atol=1e-7)
    back = camera
    for _ in range(4):
        back = rotated_clockwise(back)
    np.testing.assert_allclose(back.params, camera.params)
    np.testing.assert_allclose(back.world_from_camera, camera.world_from_camera)


def test_similarities() -> None:
    rotation = random_pose(6)[:3, :3]
    similarity = Similarity(2.5, rotation, np.array([1.0, -2.0, 3.0]))
    points = np.random.default_rng(7).normal(size=(10, 3))
    np.testing.assert_allclose(similarity.inverse().points(similarity.points(points)), points, atol=1e-12)
    np.testing.assert_allclose(similarity.points(points), points @ similarity.matrix()[:3, :3].T + similarity.matrix()[:3, 3], atol=1e-12)
    np.testing.assert_allclose(similarity.inverse().matrix() @ similarity.matrix(), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(Similarity.identity().points(points), points)
    pose = similarity.pose(random_pose(8))
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(similarity.inverse().pose(pose), random_pose(8), atol=1e-12)


def test_a_moved_camera_sees_the_moved_world() -> None:
    similarity = Similarity(0.3, random_pose(9)[:3, :3], np.array([1.0, -2.0, 3.0]))
    camera = camera_of("OPENCV")
    pixels = np.random.default_rng(10).uniform((0, 0), (640, 480), (20, 2))
    points = rays(camera, pixels)[0] + 3 * rays(camera, pixels)[1]
    seen, depth = project(similarity.camera(camera), similarity.points(points))
    np.testing.assert_allclose(seen, pixels, atol=1e-7)
    np.testing.assert_allclose(depth, 0.3 * project(camera, points)[1], rtol=1e-9)


def test_axes_of_other_programs() -> None:
    pose = random_pose(11)
    np.testing.assert_allclose(pose_from_opengl(pose_from_opengl(pose)), pose)
    # Blender: x right, y up, looking along -z.
    np.testing.assert_allclose(pose_from_opengl(np.eye(4))[:3, :3], np.diag([1, -1, -1]))
    # LLFF: columns down, right, back.
    right, down, forward = pose[:3, 0], pose[:3, 1], pose[:3, 2]
    np.testing.assert_allclose(pose_from_llff(np.stack([down, right, -forward, pose[:3, 3]], -1)), pose)
    camera = Camera("a", 2, 2, "SIMPLE_PINHOLE", (1.0, 1.0, 1.0), pose)
    np.testing.assert_allclose(camera.up, -down)
    np.testing.assert_allclose(camera.forward, forward)


def test_colmaps_quaternion() -> None:
    pycolmap = pytest.importorskip("pycolmap")
    wxyz, translation = np.array([0.5, 0.1, -0.7, 0.3]), np.array([1.0, 2.0, 3.0])
    wxyz /= np.linalg.norm(wxyz)
    theirs = pycolmap.Rigid3d(pycolmap.Rotation3d(wxyz[[1, 2, 3, 0]]), translation).matrix()
    np.testing.assert_allclose(np.linalg.inv(pose_from_colmap(wxyz, translation))[:3], theirs, atol=1e-12)
