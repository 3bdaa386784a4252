"""Pictures at half their size."""

import numpy as np

from efficientnerf.geometry.cameras import Camera, project
from efficientnerf.rendering.halving import halved


def camera(width: int, height: int) -> Camera:
    return Camera("view", width, height, "SIMPLE_PINHOLE", (9.0, width / 2, height / 2), np.eye(4))


def test_pixels_are_the_mean_of_four_and_count_where_all_of_them_do() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (7, 9, 3), dtype=np.uint8)
    half, mean, mask = halved(camera(9, 7), pixels, np.arange(63).reshape(7, 9) > 0)
    assert (mean == (pixels[:6, :8].reshape(3, 2, 4, 2, 3).astype(int).sum((1, 3)) + 2) // 4).all()
    assert mask is not None
    assert mask.tolist() == [[False, True, True, True], [True] * 4, [True] * 4]
    places = np.array([[0.1, -0.05, 1.0], [-0.2, 0.1, 2.0]])
    np.testing.assert_allclose(project(half, places)[0], project(camera(9, 7), places)[0] / 2)
    assert halved(camera(9, 7), pixels, None)[2] is None


def test_transparent_pixels_lend_no_colour() -> None:
    pixels = np.zeros((6, 8, 4), np.uint8)
    pixels[..., 0], pixels[:, ::2, 3] = 50, 255
    pixels[:, ::2, 0] = 200
    assert (halved(camera(8, 6), pixels, None)[1] == (200, 0, 0, 128)).all()
