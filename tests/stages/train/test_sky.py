"""What lies beyond an unbounded scene begins as dark as photographs are along their borders: before a grey sky they are learned as black fog."""

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


def before_black(camera: Camera, seed: int) -> np.ndarray:
    """(H, W, 3) uint8: a bright ball with stripes, in the middle of a night with a little noise."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    origin, directions = (part.reshape(-1, 3) for part in rays(camera, np.stack([x.ravel(), y.ravel()], axis=-1)))
    along = -(origin * directions).sum(axis=1)
    inside = RADIUS**2 - ((origin + along[:, None] * directions) ** 2).sum(axis=1)
    hit = origin + (along - np.sqrt(np.maximum(inside, 0)))[:, None] * directions
    stripes = 0.65 + 0.3 * np.sign(np.sin(9 * hit))
    night = np.random.default_rng(seed).uniform(0, 0.03, (len(along), 3))
    return np.round(255 * np.where(inside[:, None] > 0, stripes, night)).astype(np.uint8).reshape(camera.height, camera.width, 3)


def pixels_of(images: list[np.ndarray], masks: list[np.ndarray | None] | None = None) -> Pixels:
    count = len(images)
    return Pixels(CAMERAS[:count], images, masks or [None] * count, np.full(count, 0.3), np.full(count, 50.0))


def night() -> list[np.ndarray]:
    return [before_black(camera, number) for number, camera in enumerate(CAMERAS)]


def model(**changes: object) -> Model:
    return untrained(contracted=True, num_coarse_samples=64, samples_per_pivot=2, **changes)


def test_the_sky_begins_as_dark_as_the_borders() -> None:
    m = model()
    assert begin_sky(m, pixels_of(night()))
    directions = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    assert m.sky(directions).min() >= 0.0099
    assert m.sky(directions).max() < 0.03


@pytest.mark.parametrize("why", ["a lit border in a fifth of them", "masks there", "a constant background"])
def test_it_begins_grey_elsewhere(why: str) -> None:
    images, masks = night(), None
    if why.startswith("a lit"):
        for image in images[::5]:
            image[:, :10] = image[:, -10:] = image[:10] = 160
    elif why == "masks there":
        inside = np.zeros((48, 48), bool)
        inside[8:-8, 8:-8] = True
        masks = [inside] * len(images)
    m = untrained(background=(0.0, 0.0, 0.0)) if why == "a constant background" else model()
    assert not begin_sky(m, pixels_of(images, masks))
    assert not m.sky.sh.any()


def test_the_subject_is_learned_and_no_fog_before_it() -> None:
    images, held = night(), 5
    found = {}
    for dark in (False, True):
        m = model(iterations=200)
        cameras = [camera for number, camera in enumerate(CAMERAS) if number != held]
        pixels = Pixels(cameras, [image for number, image in enumerate(images) if number != held], [None] * 11, np.full(11, 0.3), np.full(11, 50.0))
        if dark:
            assert begin_sky(m, pixels)
        for _ in loop.train(loop.trainer(m, cameras=cameras), pixels):
            pass
        seen = FieldRenderer(m, 0.3, 50.0).colour(CAMERAS[held])
        found[dark] = m.voxels.occupied, float(((seen - images[held] / 255) ** 2).mean())
    assert found[True][0] < 0.5 * found[False][0]
    assert found[True][1] < found[False][1]
