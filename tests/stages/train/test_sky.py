"""The sky of an unbounded scene begins with the plain colour that photographs have along their borders: before a grey one it is learned as fog."""

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


def photograph(camera: Camera, seed: int, backdrop: float) -> np.ndarray:
    """(H, W, 3) uint8: a ball with stripes before a backdrop with a little noise."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    origin, directions = (part.reshape(-1, 3) for part in rays(camera, np.stack([x.ravel(), y.ravel()], axis=-1)))
    along = -(origin * directions).sum(axis=1)
    inside = RADIUS**2 - ((origin + along[:, None] * directions) ** 2).sum(axis=1)
    hit = origin + (along - np.sqrt(np.maximum(inside, 0)))[:, None] * directions
    stripes = 0.5 + 0.3 * np.sign(np.sin(9 * hit))
    noisy = backdrop + np.random.default_rng(seed).uniform(-0.015, 0.015, (len(along), 3))
    return np.round(255 * np.where(inside[:, None] > 0, stripes, noisy)).astype(np.uint8).reshape(camera.height, camera.width, 3)


def pixels_of(images: list[np.ndarray], masks: list[np.ndarray | None] | None = None) -> Pixels:
    count = len(images)
    return Pixels(CAMERAS[:count], images, masks or [None] * count, np.full(count, 0.3), np.full(count, 50.0))


def photographs(backdrop: float = 0.015) -> list[np.ndarray]:
    return [photograph(camera, number, backdrop) for number, camera in enumerate(CAMERAS)]


def model(**changes: object) -> Model:
    return untrained(contracted=True, num_coarse_samples=64, samples_per_pivot=2, **changes)


@pytest.mark.parametrize("backdrop", [0.015, 0.3, 0.97])
def test_the_sky_begins_with_the_colour_of_the_borders(backdrop: float) -> None:
    m = model()
    assert begin_sky(m, pixels_of(photographs(backdrop)))
    directions = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    assert np.abs(m.sky(directions).detach().numpy() - backdrop).max() < 0.01


@pytest.mark.parametrize("why", ["texture", "a gradient", "other colours in a fifth of them", "masks there", "a constant background", "alpha"])
def test_it_begins_grey_elsewhere(why: str) -> None:
    images, masks, m = photographs(), None, model()
    for number, image in enumerate(images):
        if why == "texture":
            image[::2] = 160
        elif why == "a gradient":
            image[:] = np.linspace(60, 200, 48).astype(np.uint8)[:, None, None]
        elif why.startswith("other") and number % 5 == 0:
            image[:] = 160
    if why == "alpha":
        images = [np.dstack([image, np.full(image.shape[:2], 255, np.uint8)]) for image in images]
    if why == "masks there":
        inside = np.zeros((48, 48), bool)
        inside[8:-8, 8:-8] = True
        masks = [inside] * len(images)
    elif why == "a constant background":
        m = untrained(background=(0.0, 0.0, 0.0))
    assert not begin_sky(m, pixels_of(images, masks))
    assert not m.sky.sh.any()


@pytest.mark.parametrize("backdrop", [0.015, 0.97])
def test_the_subject_is_learned_and_no_fog_before_it(backdrop: float) -> None:
    images, held = photographs(backdrop), 5
    found = {}
    for plain in (False, True):
        m = model(iterations=200)
        cameras = [camera for number, camera in enumerate(CAMERAS) if number != held]
        pixels = Pixels(cameras, [image for number, image in enumerate(images) if number != held], [None] * 11, np.full(11, 0.3), np.full(11, 50.0))
        if plain:
            assert begin_sky(m, pixels)
        for _ in loop.train(loop.trainer(m, cameras=cameras), pixels):
            pass
        seen = FieldRenderer(m, 0.3, 50.0).colour(CAMERAS[held])
        found[plain] = m.voxels.occupied, float(((seen - images[held] / 255) ** 2).mean())
    assert found[True][0] < 0.5 * found[False][0], found
    assert found[True][1] < 0.7 * found[False][1], found
