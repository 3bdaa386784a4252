"""The sky of an unbounded scene begins with what photographs show of it, along their borders or above the horizon: before a grey one it is learned as fog."""

import numpy as np
import pytest
import torch

from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.model import Model
from efficientnerf.rendering.field_renderer import FieldRenderer
from efficientnerf.training import loop
from efficientnerf.training.pixels import Pixels
from stages.train.data import begin_sky
from tests.efficientnerf.balls import untrained
from tests.efficientnerf.surroundings import around

CAMERAS = around(12, 48)
RADIUS = 0.6


def sky(directions: np.ndarray) -> np.ndarray:
    """(R, 3) colours of a sky that is brighter towards the horizon, and on one side."""
    x, _, z = directions.T
    return np.stack([0.75 - 0.45 * z + 0.1 * x, 0.8 - 0.3 * z + 0.1 * x, 0.85 - 0.1 * z + 0.05 * x], axis=1)


def photograph(camera: Camera, seed: int, backdrop: float | None) -> np.ndarray:
    """(H, W, 3) uint8: a ball with stripes before a backdrop with a little noise; None: on chequered ground, below a sky."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    origin, directions = (part.reshape(-1, 3) for part in rays(camera, np.stack([x.ravel(), y.ravel()], axis=-1)))
    along = -(origin * directions).sum(axis=1)
    inside = RADIUS**2 - ((origin + along[:, None] * directions) ** 2).sum(axis=1)
    hit = origin + (along - np.sqrt(np.maximum(inside, 0)))[:, None] * directions
    stripes = 0.5 + 0.3 * np.sign(np.sin(9 * hit))
    noise = np.random.default_rng(seed).uniform(-0.015, 0.015, (len(along), 3))
    if backdrop is None:
        ground = origin + ((-RADIUS - origin[:, 2:]) / np.minimum(directions[:, 2:], -1e-3)) * directions
        noisy = np.where(directions[:, 2:] > 0, sky(directions), 0.5 + 0.3 * np.sign(np.sin(4 * ground[:, :2]).prod(axis=1))[:, None]) + noise / 4
    else:
        noisy = backdrop + noise
    return np.round(255 * np.where(inside[:, None] > 0, stripes, noisy)).astype(np.uint8).reshape(camera.height, camera.width, 3)


def pixels_of(images: list[np.ndarray], masks: list[np.ndarray | None] | None = None, cameras: list[Camera] = CAMERAS) -> Pixels:
    count = len(images)
    return Pixels(cameras[:count], images, masks or [None] * count, np.full(count, 0.3), np.full(count, 50.0))


def photographs(backdrop: float | None = 0.015) -> list[np.ndarray]:
    return [photograph(camera, number, backdrop) for number, camera in enumerate(CAMERAS)]


def model(**changes: object) -> Model:
    return untrained(contracted=True, num_coarse_samples=64, samples_per_pivot=2, **changes)


@pytest.mark.parametrize("backdrop", [0.015, 0.3, 0.97])
def test_the_sky_begins_with_the_colour_of_the_borders(backdrop: float) -> None:
    m = model()
    assert "borders" in str(begin_sky(m, pixels_of(photographs(backdrop))))
    directions = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    assert np.abs(m.sky(directions).detach().numpy() - backdrop).max() < 0.01


def directions_at(heights: tuple[float, ...]) -> np.ndarray:
    """Unit directions all round, at these heights."""
    turn = np.linspace(0, 2 * np.pi, 16)
    return np.concatenate([np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), np.full(16, z)], axis=1) for z in heights])


@pytest.mark.parametrize("dark", [[], [0, 5]])
def test_the_sky_begins_with_what_is_plain_above_the_horizon(dark: list[int]) -> None:
    m, cameras = model(), around(12, 96)
    images = [photograph(camera, number, None) for number, camera in enumerate(cameras)]
    for number in dark:
        images[number][:, :30] = 40  # something right before the camera
    assert "horizon" in str(begin_sky(m, pixels_of(images, cameras=cameras)))
    above, below = directions_at((0.2, 0.3)), directions_at((-0.4, -0.9))
    assert np.abs(m.sky(torch.from_numpy(above.astype(np.float32))).detach().numpy() - sky(above)).max() < 0.1
    assert np.abs(m.sky(torch.from_numpy(below.astype(np.float32))).detach().numpy() - 0.5).max() < 0.15


@pytest.mark.parametrize("why", ["texture", "a steep gradient", "other colours in each", "only two", "masks there", "a constant background", "alpha"])
def test_it_begins_grey_elsewhere(why: str) -> None:
    images, masks, m = photographs(None if why == "only two" else 0.015), None, model()
    for number, image in enumerate(images):
        if why == "texture":
            image[::2] = 160
        elif why == "a steep gradient":
            image[:] = np.linspace(60, 200, 48).astype(np.uint8)[:, None, None]
        elif why.startswith("other"):
            image[:] = 97 * number % 240
        elif why == "only two" and number not in (2, 7):
            image[:] = np.random.default_rng(number).integers(0, 255, image.shape)
    if why == "alpha":
        images = [np.dstack([image, np.full(image.shape[:2], 255, np.uint8)]) for image in images]
    if why == "masks there":
        inside = np.zeros((48, 48), bool)
        inside[8:-8, 8:-8] = True
        masks = [inside] * len(images)
    elif why == "a constant background":
        m = untrained(background=(0.0, 0.0, 0.0))
    assert begin_sky(m, pixels_of(images, masks)) is None
    assert not m.sky.sh.any()


@pytest.mark.parametrize("backdrop", [0.015, None])
def test_the_subject_is_learned_and_no_fog_before_it(backdrop: float | None) -> None:
    images, held = photographs(backdrop), 5
    found = {}
    for plain in (False, True):
        m = model(iterations=200)
        cameras = [camera for number, camera in enumerate(CAMERAS) if number != held]
        pixels = Pixels(cameras, [image for number, image in enumerate(images) if number != held], [None] * 11, np.full(11, 0.3), np.full(11, 50.0))
        if plain:
            assert begin_sky(m, pixels) is not None
        for _ in loop.train(loop.trainer(m, cameras=cameras), pixels):
            pass
        seen = FieldRenderer(m, 0.3, 50.0).colour(CAMERAS[held])
        found[plain] = m.voxels.occupied, float(((seen - images[held] / 255) ** 2).mean())
    assert found[True][0] < 0.5 * found[False][0], found
    assert backdrop is None or found[True][1] < 0.7 * found[False][1], found  # of a sky no harmonics are all: the asset has them from the photographs
