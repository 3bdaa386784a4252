"""Surfaces fitted to photographs: a textured plane of which the truth is known, and scores against slow ones."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from efficientnerf.backends.numba.mesh import photometric as kernel
from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.surface.fitting.photometric import refined
from efficientnerf.surface.texturing.photographs import Photograph
from tests.poses import looking_at

SIDE, PIXELS = 41, 160


def cameras(count: int) -> list[Camera]:
    """Around the z axis, 30 degrees off it, looking at the origin."""
    found = []
    for turn in np.arange(count) * 2 * np.pi / max(count, 1):
        centre = 3 * np.array([np.sin(0.5) * np.cos(turn), np.sin(0.5) * np.sin(turn), np.cos(0.5)])
        pose = looking_at(centre, up=(0.3, 0.9, 0.1))
        found.append(Camera(f"{turn:.2f}", PIXELS, PIXELS, "SIMPLE_PINHOLE", (200.0, PIXELS / 2, PIXELS / 2), pose))
    return found


def photographs(count: int, contrast: float, gain: float = 1.0) -> list[Photograph]:
    """Of the plane z = 0 with a random pattern; each `gain` times as bright as the one before."""
    pattern = gaussian_filter(np.random.default_rng(0).normal(size=(400, 400)), 2.5)
    pattern = 120 + contrast * pattern / pattern.std()
    found = []
    for number, camera in enumerate(cameras(count)):
        origins, directions = rays(camera)
        at = origins - (origins[..., 2] / directions[..., 2])[..., None] * directions
        value = map_coordinates(pattern, (at[..., :2].reshape(-1, 2).T + 2) * 100, order=1, mode="nearest").reshape(PIXELS, PIXELS)
        grey = np.clip(value * gain**number, 0, 255).astype(np.uint8)
        found.append(Photograph(camera, np.repeat(grey[..., None], 3, 2), np.ones(grey.shape, bool)))
    return found


def sheet(height: float) -> tuple[np.ndarray, np.ndarray]:
    """A square sheet seen from above, with a wave of this height."""
    x, y = np.meshgrid(*[np.linspace(-0.5, 0.5, SIDE)] * 2, indexing="ij")
    vertices = np.stack([x, y, height * np.cos(4 * x) * np.cos(3 * y)], -1).reshape(-1, 3)
    corner = (np.arange(SIDE - 1)[:, None] * SIDE + np.arange(SIDE - 1)).ravel()
    faces = np.concatenate([np.stack([corner, corner + SIDE, corner + 1], 1), np.stack([corner + 1, corner + SIDE, corner + SIDE + 1], 1)])
    return vertices, faces


@pytest.mark.parametrize("gain", [1.0, 0.93])
@pytest.mark.parametrize("height", [0.025, -0.025])
def test_a_surface_off_the_truth_is_moved_to_it(height: float, gain: float) -> None:
    vertices, faces = sheet(height)
    found = refined(vertices, faces, photographs(6, 30, gain))
    assert found.improved
    assert found.seen > 0.7
    assert found.after > max(found.before, 0.9)
    assert np.abs(found.vertices[:, 2]).mean() < 0.2 * np.abs(vertices[:, 2]).mean()
    assert np.abs(found.vertices[:, :2] - vertices[:, :2]).max() < 0.02  # vertices do not wander along the surface


def test_a_true_surface_stays() -> None:
    vertices, faces = sheet(0.0)
    assert np.abs(refined(vertices, faces, photographs(6, 30)).vertices - vertices).max() < 0.003  # a fifth of a pixel


@pytest.mark.parametrize(("count", "contrast"), [(6, 0.0), (2, 30.0), (0, 30.0)])
def test_plain_photographs_and_two_alone_move_nothing(count: int, contrast: float) -> None:
    vertices, faces = sheet(0.025)
    found = refined(vertices, faces, photographs(count, contrast))
    assert not found.improved
    np.testing.assert_array_equal(found.vertices, vertices)


def test_one_photograph_that_shows_something_else_does_not_decide() -> None:
    vertices, faces = sheet(0.025)
    photos = photographs(6, 30)
    photos[2] = Photograph(photos[2].camera, np.random.default_rng(1).integers(0, 255, photos[2].colours.shape).astype(np.uint8), photos[2].usable)
    assert np.abs(refined(vertices, faces, photos).vertices[:, 2]).mean() < 0.35 * np.abs(vertices[:, 2]).mean()


def test_the_same_photographs_give_the_same_bytes() -> None:
    vertices, faces = sheet(0.025)
    photos = photographs(5, 30)
    assert refined(vertices, faces, photos).vertices.tobytes() == refined(vertices, faces, photos).vertices.tobytes()


def test_scores_are_those_of_a_slow_loop() -> None:
    rng = np.random.default_rng(3)
    greys = [gaussian_filter(rng.normal(size=(40, 50)), 1.5) for _ in range(4)]
    greys = [np.clip(128 + 60 * grey / grey.std(), 0, 255).astype(np.uint8) for grey in greys]
    count, offsets = 5, 3
    chosen = np.tile(np.array([2, 0, 3, 1, -1], np.int32), (count, 1))
    places = np.concatenate([rng.uniform(12, 28, (count, 5, 2)), rng.normal(0, 1, (count, 5, 6))], 2).astype(np.float32)
    size, step = np.full(count, 0.7, np.float32), np.full(count, 0.5, np.float32)
    score, texture = np.zeros((count, offsets), np.float32), np.zeros(count, np.float32)
    starts, shapes = np.arange(4, dtype=np.int64) * 2000, np.array([grey.shape for grey in greys], np.int64)
    kernel.agreement(0, count, chosen, places, size, step, np.concatenate([grey.ravel() for grey in greys]), starts, shapes, np.float32(2), score, texture)
    a, b = np.meshgrid(np.arange(-3, 4), np.arange(-3, 4))
    for vertex in range(count):
        for s in range(offsets):
            patches = []
            for place in range(4):
                p = places[vertex, place].astype(np.float64)
                u, v = (p[k] + (s - 1) * 0.5 * p[2 + k] + 0.7 * (a * p[4 + k] + b * p[6 + k]) for k in (0, 1))
                if min(u.min(), v.min()) >= 1 and u.max() < 48 and v.max() < 38:
                    patches.append(map_coordinates(greys[chosen[vertex, place]].astype(float), [v.ravel(), u.ravel()], order=1))
                else:
                    patches.append(None)
            if patches[0] is None or sum(patch is not None for patch in patches[1:]) < 2:
                continue
            found = sorted(float(np.corrcoef(patches[0], patch)[0, 1]) for patch in patches[1:] if patch is not None)
            assert score[vertex, s] == pytest.approx(np.mean(found[-max(2, (len(found) + 1) // 2) :]), abs=2e-3)
            if s == 1:
                assert texture[vertex] == pytest.approx(np.std(patches[0]), rel=1e-3)
