"""Edges of square markers by known cameras: exact without noise, within the stated error with it, and no place for what moves."""

import numpy as np
from scipy.spatial.transform import Rotation

from efficientnerf.capture.markers import SQUARE, common_length, common_normal, fit_square
from efficientnerf.geometry.cameras import Camera, Similarity, project
from tests.efficientnerf.capture.rings import cameras_round


def square_at(place: tuple[float, float, float], edge: float = 0.12, turn: float = 0.3) -> Similarity:
    cos, sin = np.cos(turn), np.sin(turn)
    return Similarity(edge, np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]), np.array(place))


def seen(cameras: list[Camera], square: Similarity, rng: np.random.Generator, noise: float) -> np.ndarray:
    points = square.points(SQUARE)
    return np.stack([project(camera, points)[0] for camera in cameras]) + noise * rng.normal(size=(len(cameras), 4, 2))


def test_a_square_is_found_exactly_through_any_lens() -> None:
    rng = np.random.default_rng(0)
    for model in ("OPENCV", "OPENCV_FISHEYE"):
        cameras = cameras_round(6, rng, model)
        square = square_at((0.1, 0.2, 0.0))
        fit = fit_square(cameras, seen(cameras, square, rng, 0.0))
        assert fit.still
        assert abs(fit.square.scale / square.scale - 1) < 1e-6
        np.testing.assert_allclose(fit.corners, square.points(SQUARE), atol=1e-6)


def test_the_true_length_lies_within_the_stated_error() -> None:
    outside, errors = 0, []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        cameras = cameras_round(int(rng.integers(3, 9)), rng)
        squares = [square_at((x, rng.uniform(-0.5, 0.5), 0.0), turn=rng.uniform(0, 6)) for x in np.linspace(-0.4, 0.4, int(rng.integers(1, 5)))]
        length, error, _ = common_length([fit_square(cameras, seen(cameras, square, rng, 0.5)) for square in squares])
        errors.append(abs(length / 0.12 - 1))
        outside += errors[-1] > error
    assert outside < 5, outside
    assert np.median(errors) < 0.005


def test_few_wrong_views_are_left_out_and_what_moves_is_not_still() -> None:
    rng = np.random.default_rng(1)
    cameras = cameras_round(10, rng)
    here, there = (seen(cameras, square_at((x, 0.0, 0.0)), rng, 0.2) for x in (0.0, 0.3))
    few, half = here.copy(), here.copy()
    few[[2, 7]], half[5:] = there[[2, 7]], there[5:]
    fit = fit_square(cameras, few)
    assert fit.still
    assert fit.agrees.sum() == 8
    assert abs(fit.square.scale / 0.12 - 1) < 0.005
    assert not fit_square(cameras, half).still


def test_markers_of_two_sizes_are_farther_apart_than_their_errors() -> None:
    rng = np.random.default_rng(2)
    cameras = cameras_round(8, rng)
    fits = [fit_square(cameras, seen(cameras, square_at((x, 0.0, 0.0), edge), rng, 0.2)) for x, edge in ((-0.3, 0.12), (0.0, 0.12), (0.3, 0.15))]
    assert common_length(fits)[2] > 10
    assert common_length(fits[:2])[2] < 3


def test_markers_in_a_plane_have_its_normal() -> None:
    rng = np.random.default_rng(3)
    cameras = cameras_round(8, rng)
    places = [(-0.4, -0.3, 0.0), (0.4, -0.3, 0.0), (0.0, 0.4, 0.0)]
    fits = [fit_square(cameras, seen(cameras, square_at(place), rng, 0.2)) for place in places]
    normal = common_normal(fits)
    assert normal is not None
    assert normal[0][2] > np.cos(np.radians(min(1.0, normal[1])))
    assert common_normal(fits[:2]) is None
    raised = fit_square(cameras, seen(cameras, square_at((0.3, 0.4, 0.3)), rng, 0.2))
    assert common_normal([*fits, raised]) is None


def test_up_lies_within_the_stated_error_where_cameras_are_off() -> None:
    outside, known = 0, 0
    for seed in range(25):
        rng = np.random.default_rng(seed)
        cameras = cameras_round(int(rng.integers(4, 9)), rng)
        off = [Similarity(1.0, Rotation.from_rotvec(rng.normal(0, 2e-4, 3)).as_matrix(), rng.normal(0, 1.5e-3, 3)).camera(camera) for camera in cameras]
        squares = [square_at((*rng.uniform(-0.4, 0.4, 2), 0.0), turn=rng.uniform(0, 6)) for _ in range(int(rng.integers(3, 7)))]
        normal = common_normal([fit_square(off, seen(cameras, square, rng, 0.2)) for square in squares])
        if normal is not None:
            known += 1
            outside += np.degrees(np.arccos(min(1.0, normal[0][2]))) > normal[1]
    assert known > 12
    assert outside <= 0.05 * known, (outside, known)
