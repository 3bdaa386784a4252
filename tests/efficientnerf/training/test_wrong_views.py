"""Cameras that are wrong are found by the field, photographs that merely look different are not."""

import copy
import itertools
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from efficientnerf.geometry.cameras import Camera, project, rays
from efficientnerf.model import Model
from efficientnerf.training import loop
from efficientnerf.training.loop import Trainer, restore, state_of, trainer
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.view_checks import checks, residuals
from efficientnerf.training.view_checks.checks import (
    MAX_LEFT_OUT,
    MIN_VIEWS,
    Observations,
    ViewChecks,
    check,
    follow_checks,
    is_due,
    point_evidence,
)  # fmt: skip
from efficientnerf.training.view_checks.pose_search import best_shift, corrected, motion, rotation_matrix, turned
from efficientnerf.training.view_checks.residuals import cells_of, global_error, local_error
from tests.efficientnerf import balls

COUNT, SIDE = 24, 32
WAVES = np.array([[7.0, 2.0, -4.0], [-3.0, 8.0, 2.0], [4.0, -2.0, 7.0]])


def camera(n: int, side: int = SIDE) -> Camera:
    pose = balls.pose(2 * math.pi * n / COUNT, 0.35 + 0.3 * math.sin(5.0 * n), 2.2)
    return Camera(f"v{n:02}.png", side, side, "SIMPLE_PINHOLE", (1.3 * side, side / 2, side / 2), pose)


def picture(seen_by: Camera) -> np.ndarray:
    """(H, W, 4) uint8: the ball with bright and dark spots."""
    image = balls.picture(seen_by)
    origins, directions = rays(seen_by)
    middle = ((balls.CENTRE - origins) * directions).sum(-1)
    chord = np.sqrt(np.maximum(balls.RADIUS**2 - ((balls.CENTRE - origins) ** 2).sum(-1) + middle**2, 0))
    hit = origins + (middle - chord)[:, None] * directions
    image[..., :3] = np.round(255 * (0.5 + 0.4 * np.sin(hit @ WAVES.T))).reshape(image[..., :3].shape)
    return image


CAMERAS = [camera(n) for n in range(COUNT)]
PICTURES = [picture(each) for each in CAMERAS]


def pixels_of(cameras: list[Camera], pictures: list[np.ndarray]) -> Pixels:
    return Pixels(cameras, pictures, [None] * len(cameras), np.full(len(cameras), 0.6), np.full(len(cameras), 4.0))


def rotated(n: int, degrees: float, axis: tuple[float, float, float] = (0.6, 0.7, 0.39)) -> Camera:
    """The camera, turned about its own place."""
    pose = CAMERAS[n].world_from_camera.copy()
    pose[:3, :3] = pose[:3, :3] @ rotation_matrix(math.radians(degrees) * np.array(axis) / np.linalg.norm(axis))
    return replace(CAMERAS[n], world_from_camera=pose)


def train(t: Trainer, pixels: Pixels) -> None:
    for _ in itertools.islice(loop.train(t, pixels), 300):
        pass


def untrained(cameras: list[Camera]) -> Trainer:
    """Of 3000 steps. On 32 voxels a side, as many as pictures have pixels: a search finds poses in smooth fields."""
    return trainer(balls.untrained(iterations=3000, num_levels=6, sample_batch_size=12288, finest_resolution=32), cameras=cameras)


@pytest.fixture(scope="module")
def fields() -> tuple[Model, Model]:
    """A field of the true cameras after some steps, and after twice as many."""
    t, pixels = untrained(CAMERAS), pixels_of(CAMERAS, PICTURES)
    train(t, pixels)
    early = copy.deepcopy(t.model)
    train(t, pixels)
    return early, t.model


@pytest.fixture
def field(fields: tuple[Model, Model]) -> Model:
    return fields[0]


@pytest.fixture
def settled(fields: tuple[Model, Model]) -> Model:
    return fields[1]


def angle(a: Camera, b: Camera) -> float:
    return math.degrees(math.acos(np.clip((np.trace(a.world_from_camera[:3, :3].T @ b.world_from_camera[:3, :3]) - 1) / 2, -1, 1)))


def test_motion_is_the_derivative_of_the_projection() -> None:
    lens = replace(CAMERAS[0], model="RADIAL", params=(40.0, 15.0, 17.0, -0.05, 0.01))
    points = balls.CENTRE + np.random.default_rng(1).uniform(-0.5, 0.5, (20, 3))
    change = 1e-4 * np.random.default_rng(2).normal(size=6)
    before, after = project(lens, points)[0], project(corrected(lens, change, 3.0), points)[0]
    np.testing.assert_allclose(motion(lens, 3.0, points) @ change, after - before, atol=2e-3 * np.abs(after - before).max())


def found(m: Model, cameras: list[Camera], pictures: list[np.ndarray], observed: Observations | None = None) -> ViewChecks:
    """After one check."""
    c = ViewChecks.none(cameras)
    check(c, m, pixels_of(cameras, pictures), observed, 300)
    return c


def test_turned_cameras_are_left_out_and_their_poses_found(field: Model) -> None:
    cameras = list(CAMERAS)
    for n, degrees in ((3, 8), (11, 20), (18, 60)):
        cameras[n] = rotated(n, degrees)
    c = found(field, cameras, PICTURES)
    assert np.flatnonzero(c.left_out).tolist() == [3, 11, 18]
    for n in (3, 11, 18):
        assert c.replaced[n]
        assert angle(CAMERAS[n], replace(CAMERAS[n], world_from_camera=c.pose[n])) < 3
        assert c.evidence[n, 3] < 0.3 < c.evidence[n, 1]


def test_swapped_photographs_are_left_out_and_their_cameras_found(field: Model) -> None:
    cameras = list(CAMERAS)
    cameras[4], cameras[15] = (replace(CAMERAS[a], world_from_camera=CAMERAS[b].world_from_camera) for a, b in ((4, 15), (15, 4)))
    c = found(field, cameras, PICTURES)
    assert np.flatnonzero(c.left_out).tolist() == [4, 15]
    for n in (4, 15):
        assert angle(CAMERAS[n], replace(CAMERAS[n], world_from_camera=c.pose[n])) < 3


def test_a_photograph_of_something_else_is_left_out_and_no_pose_is_believed(field: Model) -> None:
    other = PICTURES[6].copy()
    other[..., :3] = np.random.default_rng(1).integers(0, 2, (8, 8, 3), np.uint8).repeat(4, axis=0).repeat(4, axis=1) * 255
    other[..., 3] = 255
    c = found(field, CAMERAS, [*PICTURES[:6], other, *PICTURES[7:]])
    assert np.flatnonzero(c.left_out).tolist() == [6]


def blurred(image: np.ndarray) -> np.ndarray:
    import cv2

    return cv2.GaussianBlur(image, (0, 0), 1.2)


def exposed(image: np.ndarray, stops: float) -> np.ndarray:
    out = image.copy()
    out[..., :3] = np.clip(image[..., :3] * 2 ** (stops / 2.2), 0, 255)
    return out


def covered(image: np.ndarray) -> np.ndarray:
    out = image.copy()
    out[12:, 4:15] = [200, 30, 30, 255]
    return out


def warm(image: np.ndarray) -> np.ndarray:
    out = image.copy()
    out[..., :3] = image[..., :3] * [1.0, 0.8, 0.5]
    return out


@pytest.mark.parametrize(
    "change", [lambda i: exposed(i, 1), lambda i: exposed(i, -1), warm, blurred, covered], ids=["+1 EV", "-1 EV", "warm", "blurred", "covered"]
)
def test_photographs_that_merely_look_different_stay(field: Model, change: Callable[[np.ndarray], np.ndarray]) -> None:
    pictures = [change(image) if n in (5, 16) else image for n, image in enumerate(PICTURES)]
    assert not found(field, CAMERAS, pictures).left_out.any()


def test_no_more_than_a_share_is_left_out_and_of_few_views_none(field: Model) -> None:
    most = int(MAX_LEFT_OUT * COUNT)
    cameras = [rotated(n, 30) if n % 4 == 0 else each for n, each in enumerate(CAMERAS)]  # 6 of 24
    assert 0 < found(field, cameras, PICTURES).left_out.sum() <= most
    few = ViewChecks.none([rotated(0, 30), *CAMERAS[1:MIN_VIEWS]])
    assert not any(is_due(few, number, 0.3) for number in range(5000))
    barely = [rotated(n, 30) if n < 3 else each for n, each in enumerate(CAMERAS[: MIN_VIEWS + 1])]
    assert found(field, barely, PICTURES[: MIN_VIEWS + 1]).left_out.sum() <= 1


def observations() -> Observations:
    """Points on the ball, as the true cameras observe them."""
    side = np.random.default_rng(2).normal(size=(400, 3))
    xyz = balls.CENTRE + balls.RADIUS * side / np.linalg.norm(side, axis=1, keepdims=True)
    view, point = np.nonzero([((each.centre - xyz) * (xyz - balls.CENTRE)).sum(1) > 0.4 for each in CAMERAS])
    return Observations(xyz[point], 0.5 + 0.4 * np.sin(xyz[point] @ WAVES.T), view)


def test_sparse_points_speak_for_true_cameras_and_against_wrong_ones() -> None:
    cameras = list(CAMERAS)
    for n, degrees in ((3, 8), (11, 60)):
        cameras[n] = rotated(n, degrees)
    cells = cells_of(pixels_of(cameras, PICTURES), np.ones(3))
    speak_for, against, _ = point_evidence(cameras, cells, observations(), np.ones(COUNT, bool))
    assert np.flatnonzero(against).tolist() == [3, 11]
    assert not speak_for[[3, 11]].any()
    assert speak_for.mean() > 0.6
    cells = cells_of(pixels_of(CAMERAS, PICTURES), np.ones(3))
    speak_for, against, few = point_evidence(CAMERAS, cells, few_of(7), np.ones(COUNT, bool))
    assert not against.any()
    assert not speak_for[7]
    assert np.flatnonzero(few).tolist() == [7]
    assert not any(evidence.any() for evidence in point_evidence(CAMERAS, cells, None, np.ones(COUNT, bool)))


def few_of(view: int) -> Observations:
    """Of one view enough to look at, fewer than of others."""
    o = observations()
    some = (o.view != view) | (np.cumsum(o.view == view) <= 25)
    return Observations(o.xyz[some], o.rgb[some], o.view[some])


@pytest.mark.parametrize("has_few", [False, True])
def test_a_view_far_worse_that_observes_few_points_is_left_out_and_gets_its_pose_from_the_field_that_has_not_seen_it(
    settled: Model, monkeypatch: pytest.MonkeyPatch, has_few: bool
) -> None:
    cameras = list(CAMERAS)
    cameras[11] = rotated(11, 3)
    pixels, c, few = pixels_of(cameras, PICTURES), ViewChecks.none(cameras), np.arange(COUNT) == (11 if has_few else COUNT)
    monkeypatch.setattr(checks, "point_evidence", lambda *a: (np.zeros(COUNT, bool), np.zeros(COUNT, bool), few))
    with monkeypatch.context() as none_is_found:  # as where the field shows a second copy of the scene for this view
        none_is_found.setattr(checks, "find_pose", lambda s, view, image, usable, side, trusted: (s.cameras[view], 1.0))
        check(c, settled, pixels, observations(), 300)
        assert np.flatnonzero(c.left_out).tolist() == ([11] if has_few else [])
        if not has_few:
            return
        assert (c.evidence[11, 5], bool(c.replaced[11])) == (8, False)
        check(c, settled, pixels, observations(), 600)
        assert (bool(c.left_out[11]), bool(c.replaced[11])) == (True, False)
    check(c, settled, pixels, observations(), 900)
    assert (bool(c.left_out[11]), bool(c.replaced[11])) == (False, True)
    assert angle(CAMERAS[11], c.cameras[11]) < 1


def test_the_field_takes_back_what_it_left_out_wrongly(field: Model) -> None:
    c = ViewChecks.none(CAMERAS)
    c.left_out[8] = c.left_out[20] = c.replaced[20] = True
    c.pose[20] = rotated(20, 40).world_from_camera  # which is worse than its own
    assert check(c, field, pixels_of(CAMERAS, PICTURES), None, 500)
    assert not c.left_out.any()
    assert not c.replaced.any()
    assert np.array_equal(c.pose, np.stack([each.world_from_camera for each in CAMERAS]))


def test_a_found_pose_is_trained_on_once_the_field_agrees(settled: Model) -> None:
    """It agrees with some of them, and these are right."""
    trained_on = 0
    for view in (5, 7, 11, 14):
        cameras = [*CAMERAS[:view], rotated(view, 20), *CAMERAS[view + 1 :]]
        c, pixels = ViewChecks.none(cameras), pixels_of(cameras, PICTURES)
        assert check(c, settled, pixels, None, 600)
        assert np.flatnonzero(c.left_out).tolist() == [view]
        assert np.array_equal(c.cameras[view].world_from_camera, cameras[view].world_from_camera)  # not before
        if check(c, settled, pixels, None, 800):
            trained_on += 1
            assert not c.left_out.any()
            assert angle(c.cameras[view], CAMERAS[view]) < 2
    assert trained_on


def test_training_finds_wrong_cameras_and_draws_none_of_their_pixels() -> None:
    """The field has seen them from its first step on."""
    cameras = list(CAMERAS)
    for n, degrees in ((2, 10), (13, 45)):
        cameras[n] = rotated(n, degrees)
    t, pixels = untrained(cameras), pixels_of(cameras, PICTURES)
    train(t, pixels)
    assert check(t.checks, t.model, pixels, None, 300)
    assert np.flatnonzero(t.checks.left_out).tolist() == [2, 13]
    follow_checks(t.checks, pixels)
    drawn = pixels.view_of(pixels.choose(20000, np.random.default_rng(0)))
    assert sorted(set(drawn)) == [n for n in range(COUNT) if n not in (2, 13)]
    again = trainer(t.model, cameras=cameras)
    restore(again, state_of(t))
    assert again.checks is not None
    assert all(np.array_equal(getattr(again.checks, name), values) for name, values in t.checks.state.items())
    pixels.leave_out(np.zeros(COUNT, bool))
    assert pixels.usable_count == len(pixels)


def test_errors_do_not_depend_on_exposure_and_shifts_are_found() -> None:
    rng = np.random.default_rng(3)
    image = np.cumsum(np.cumsum(rng.normal(size=(30, 40, 3)), axis=0), axis=1)
    image = (image - image.min()) / np.ptp(image)
    weight = np.ones((30, 40))
    for other in (image, 0.4 * image + 0.1, image * [0.9, 0.7, 0.5]):
        left, variance = global_error(image, other, weight)
        assert left < 0.1 * variance
        assert local_error(image, other, weight) < 0.3
    assert global_error(image, 1 - image, weight)[0] == pytest.approx(global_error(image, 1 - image, weight)[1])
    value, shift = best_shift(image[5:25, 8:33], weight[5:25, 8:33], image[2:22, 4:29])
    assert shift.tolist() == [4, 3]
    assert value > 0.95
    moved = turned(CAMERAS[0], np.array([5.0, -3.0]))
    at, _ = project(CAMERAS[0], (moved.centre + moved.forward)[None])
    np.testing.assert_allclose(at[0], [SIDE / 2 + 5, SIDE / 2 - 3], atol=1e-4)


@pytest.mark.parametrize("size", [(300, 7), (64, 48)])
def test_cells_are_the_same_of_a_photograph_as_of_bands_of_it(size: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    height, width = size
    image = np.random.default_rng(0).integers(0, 255, (height, width, 4), np.uint8)
    seen_by = Camera("a.png", width, height, "SIMPLE_PINHOLE", (50.0, width / 2, height / 2), np.eye(4))
    pixels = Pixels([seen_by], [image], [image[..., 0] > 40], np.ones(1), np.full(1, 2.0))
    monkeypatch.setattr(residuals, "MAX_CELLS", 100)
    monkeypatch.setattr(residuals, "MIN_CELLS", 50)
    every = residuals.cells_of(pixels, np.ones(3))
    monkeypatch.setattr(residuals, "ROWS_AT_A_TIME", 1)
    bands = residuals.cells_of(pixels, np.ones(3))
    assert every.size == bands.size
    assert every.size[0] > 1
    for a, b in ((every.colour, bands.colour), (every.weight, bands.weight)):
        np.testing.assert_array_equal(a[0], b[0])
    assert every.weight[0].shape == residuals.middles(seen_by, every.size[0])[1]
