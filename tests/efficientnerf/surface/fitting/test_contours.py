"""Surfaces moved to edges of photographs: a ball before a wall, of colours that are known."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from efficientnerf.geometry.cameras import Camera
from efficientnerf.surface.fitting.contours import fitted_to_contours
from efficientnerf.surface.rasteriser import mesh_image
from efficientnerf.surface.texturing.photographs import Photograph, photograph
from tests.poses import looking_at

PIXEL = 2.0 / 160  # at the ball
BALL, WALL = (0.9, 0.3, 0.1), (0.1, 0.5, 0.8)


def scene(radius: float, wall: tuple[float, float, float] = WALL) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Vertices, faces and colours of a ball of this radius and a wall behind it; how many vertices are of the ball."""
    ball, plane = trimesh.creation.icosphere(3, radius=radius), trimesh.creation.box((0.02, 4, 4))
    plane.apply_translation((-0.8, 0, 0))
    colours = np.concatenate([np.tile(BALL, (len(ball.vertices), 1)), np.tile(wall, (len(plane.vertices), 1))])
    vertices = np.concatenate([ball.vertices, plane.vertices])
    return vertices, np.concatenate([ball.faces, np.asarray(plane.faces) + len(ball.vertices)]), colours, len(ball.vertices)


def photographs(radius: float = 0.3, count: int = 12, wall: tuple[float, float, float] = WALL) -> list[Photograph]:
    """From the side where the wall is not, in flat colours, four samples a pixel."""
    vertices, faces, colours, _ = scene(radius, wall)
    out = []
    for n in range(count):
        centre = 2 * np.array([np.cos(0.5), np.sin(0.5) * np.cos(2.4 * n), np.sin(0.5) * np.sin(2.4 * n)])
        camera = Camera(f"c{n}", 120, 110, "SIMPLE_PINHOLE", (160.0, 60.0, 55.0), looking_at(centre))
        fine = Camera(camera.name, 240, 220, "SIMPLE_PINHOLE", (320.0, 120.0, 110.0), camera.world_from_camera)
        colour = colours[faces].mean(1)[mesh_image(vertices, faces, fine).face].reshape(110, 2, 120, 2, 3).mean((1, 3))
        out.append(photograph(camera, np.round(colour * 255).astype(np.uint8)))
    return out


@pytest.mark.parametrize("radius", [0.28, 0.315])
def test_a_ball_gets_the_size_that_photographs_show(radius: float) -> None:
    vertices, faces, colours, count = scene(radius)
    found = fitted_to_contours(vertices, faces, colours, photographs)
    seen = np.abs(found.vertices[:count, 0]) < 0.1  # where contours are
    away = np.linalg.norm(found.vertices[:count][seen], axis=1)
    assert found.improved
    assert found.after < 0.6 * found.before
    assert np.abs(away - 0.3).mean() < 0.5 * abs(radius - 0.3)
    np.testing.assert_allclose(found.vertices[count:], vertices[count:], atol=0.1 * PIXEL)


def test_one_photograph_moves_nothing() -> None:
    vertices, faces, colours, _ = scene(0.28)
    found = fitted_to_contours(vertices, faces, colours, lambda: photographs(count=1))
    np.testing.assert_array_equal(found.vertices, vertices)
    assert not found.improved


def test_without_contrast_or_usable_pixels_nothing_moves() -> None:
    vertices, faces, colours, _ = scene(0.28, BALL)
    masked = [replace(photo, usable=np.zeros_like(photo.usable)) for photo in photographs()]
    for shown in (photographs(wall=BALL), masked, []):
        found = fitted_to_contours(vertices, faces, colours, lambda shown=shown: shown)  # type: ignore[misc]
        assert np.isnan(found.before)
        assert not found.improved
        np.testing.assert_array_equal(found.vertices, vertices)


def test_a_surface_at_the_edges_stays() -> None:
    vertices, faces, colours, _ = scene(0.3)
    found = fitted_to_contours(vertices, faces, colours, photographs)
    assert found.before < 0.5
    assert np.abs(found.vertices - vertices).max() < 0.5 * PIXEL


def test_photographs_that_contradict_each_other_are_refuted() -> None:
    vertices, faces, colours, _ = scene(0.3)
    shown = [photo for pair in zip(photographs(0.32), photographs(0.28)[::-1], strict=True) for photo in pair]
    found = fitted_to_contours(vertices, faces, colours, lambda: shown)
    assert np.abs(found.vertices - vertices).max() < PIXEL


def test_it_can_be_stopped() -> None:
    vertices, faces, colours, _ = scene(0.28)

    def tick() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fitted_to_contours(vertices, faces, colours, photographs, tick)
