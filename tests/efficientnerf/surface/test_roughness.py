"""Roughness in plain regions of photographs: rags are rough, walls, corners with an edge and smooth curves are not, and textured places say nothing."""

import numpy as np
import pytest

from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.surface.roughness import roughness

CAMERA = Camera("c", 320, 200, "SIMPLE_PINHOLE", (300.0, 160.0, 100.0), np.eye(4))
DIRECTIONS = rays(CAMERA)[1].reshape(200, 320, 3)
DIRECTIONS = DIRECTIONS / DIRECTIONS[..., 2:]
GREY = np.full((200, 320, 3), 0.7, np.float32)


def wall(normal: tuple[float, float, float], distance: float = 4.0) -> np.ndarray:
    """Depths of a plane before the camera."""
    unit = np.array(normal) / np.linalg.norm(normal)
    return distance / (DIRECTIONS @ unit)


def folded(seed: int) -> np.ndarray:
    """Depths of folds across and along, 16 pixels wide and half as deep."""
    across, along = (np.abs(((np.arange(n) + np.random.default_rng(seed).uniform(0, 16)) / 16) % 2 - 1) for n in (320, 200))
    return 4 + 0.1 * (across + along[:, None])


@pytest.mark.parametrize("normal", [(0, 0, 1), (0.7, 0, 1), (-0.3, 0.8, 1)])
def test_walls_are_smooth_however_they_stand(normal: tuple[float, float, float]) -> None:
    assert roughness(GREY, wall(normal), CAMERA) == 0


def test_rags_are_rough() -> None:
    found = roughness(GREY, folded(0), CAMERA)
    assert found is not None
    assert found > 0.2


def test_a_corner_is_smooth_where_its_edge_shows() -> None:
    """Two walls of unequal brightness meet at a right angle."""
    corner = np.minimum(wall((1, 0, 1)), wall((-1, 0, 1)))
    photograph = np.where((np.arange(320) < 160)[None, :, None], GREY, 0.8 * GREY)
    assert roughness(photograph, corner, CAMERA) == 0
    assert (roughness(GREY, corner, CAMERA) or 0) > 0


def test_textured_surfaces_and_holes_say_nothing() -> None:
    noise = np.random.default_rng(0).random((200, 320, 3)).astype(np.float32)
    assert roughness(noise, folded(0), CAMERA) is None
    assert roughness(GREY, np.full((200, 320), np.inf), CAMERA) is None
    assert roughness(GREY[:5, :5], np.full((5, 5), 4.0), Camera("s", 5, 5, "SIMPLE_PINHOLE", (300.0, 2.5, 2.5), np.eye(4))) is not None


def test_the_size_of_photographs_does_not_matter() -> None:
    large = Camera("l", 640, 400, "SIMPLE_PINHOLE", (600.0, 320.0, 200.0), np.eye(4))
    photograph, depth = (np.repeat(np.repeat(part, 2, axis=0), 2, axis=1) for part in (GREY, folded(0)))
    assert roughness(photograph, depth, large) == pytest.approx(roughness(GREY, folded(0), CAMERA), abs=0.05)
