"""Places by pixels of photographs with known cameras: exact without noise, lengths within the stated error with it, whatever the frame."""

import numpy as np
import pytest

from efficientnerf.capture.markers import CONFIDENCE, common_ratio
from efficientnerf.capture.triangulation import PICK_DEVIATION, Place, length_between, triangulated
from efficientnerf.geometry.cameras import Camera, Similarity, project
from tests.efficientnerf.capture.rings import cameras_round


def pixels(cameras: list[Camera], point: np.ndarray) -> np.ndarray:
    return np.stack([project(camera, point[None])[0][0] for camera in cameras])


def picked(cameras: list[Camera], point: np.ndarray, rng: np.random.Generator, noise: float = PICK_DEVIATION) -> Place:
    """By a random choice of two to four of the cameras."""
    chosen = [cameras[n] for n in rng.choice(len(cameras), rng.integers(2, 5), replace=False)]
    return triangulated(chosen, pixels(chosen, point) + noise * rng.normal(size=(len(chosen), 2)))


def test_a_place_is_found_exactly_through_any_lens() -> None:
    rng = np.random.default_rng(0)
    for model in ("OPENCV", "OPENCV_FISHEYE"):
        cameras = cameras_round(3, rng, model)
        point = rng.uniform(-0.4, 0.4, 3)
        found = triangulated(cameras, pixels(cameras, point))
        np.testing.assert_allclose(found.position, point, atol=1e-6)
        assert found.views == 3
        assert found.miss < 1e-3


def test_true_lengths_lie_within_the_stated_error_of_100_random_cases() -> None:
    """Picked with an error of a pixel, and scaled by one or two known lengths that are picked as well."""
    outside, errors = 0, []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        cameras = cameras_round(8, rng)
        true, known = rng.uniform(0.3, 3.0), [rng.uniform(-0.5, 0.5, (2, 3)) for _ in range(rng.integers(1, 3))]
        ratios, spreads = [], []
        for a, b in known:
            length, spread = length_between(picked(cameras, a, rng), picked(cameras, b, rng))
            ratios.append(true * np.linalg.norm(b - a) / length)
            spreads.append(spread / length)
        ratio, scale_error, _ = common_ratio(np.array(ratios), np.array(spreads))
        a, b = rng.uniform(-0.5, 0.5, (2, 3))
        length, spread = length_between(picked(cameras, a, rng), picked(cameras, b, rng))
        error = float(np.hypot(CONFIDENCE * spread, scale_error * length)) * ratio
        outside += abs(ratio * length - true * np.linalg.norm(b - a)) > error
        errors.append(error / (ratio * length))
    print(f"outside: {outside} of 100; median error bar {np.median(errors):.2%} of the length")
    assert outside < 5
    assert np.median(errors) < 0.05


def test_a_length_depends_on_no_frame() -> None:
    rng = np.random.default_rng(1)
    cameras = cameras_round(4, rng)
    seen = [pixels(cameras, point) + rng.normal(size=(4, 2)) for point in rng.uniform(-0.4, 0.4, (2, 3))]
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    moved = Similarity(2.5, turn * np.sign(np.linalg.det(turn)), rng.normal(size=3))
    here, there = (length_between(*(triangulated(views, each) for each in seen)) for views in (cameras, [moved.camera(camera) for camera in cameras]))
    np.testing.assert_allclose(np.array(there), 2.5 * np.array(here), rtol=1e-6)


def test_rays_that_have_no_point_in_common_are_refused() -> None:
    cameras = cameras_round(2, np.random.default_rng(2))
    with pytest.raises(ValueError, match="one line"):
        triangulated([cameras[0], cameras[0]], np.full((2, 2), 500.0))
