"""The rays of a step, and the colours that they are to have. R rays."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from efficientnerf.backends.transfer import to_device
from efficientnerf.model import Model
from efficientnerf.training.device_pixels import DevicePixels
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.settings import TrainSettings

MIN_RAYS = 64


class RayBatch(NamedTuple):
    """The first six fields are the arguments of `render_rays`."""

    # origins, directions, near, far, offset, behind: (R, 3), (R, 3), (R,), (R,), (R,), (R, 3)
    origins: Tensor
    directions: Tensor
    near: Tensor
    far: Tensor
    offset: Tensor
    behind: Tensor
    colour: Tensor  # (R, 3) of the photographs, over `behind` where they have alpha
    pixel: np.ndarray  # (R,) indices of the pixels


def ray_count(settings: TrainSettings, samples_per_ray: float) -> int:
    """Rays of a step: as many as have about `train.sample_batch_size` samples."""
    if settings.sample_batch_size == "off":
        return settings.max_rays_per_batch
    return int(min(settings.max_rays_per_batch, max(MIN_RAYS, settings.sample_batch_size / samples_per_ray)))


def ray_batch(m: Model, pixels: Pixels | DevicePixels, count: int, rng: np.random.Generator, *, crop: bool) -> RayBatch:
    """Rays through `count` random pixels; with `crop`, of the middle of the images."""
    chosen = pixels.choose(count, rng, middle=crop)
    origins, directions, near, far, colour = (torch.as_tensor(a, device=m.device) for a in pixels.bundle(chosen))
    offset = to_device(torch.from_numpy(rng.random(count, np.float32)), m.device)
    behind = m.behind(directions)
    if m.space.reaches_infinity and m.background is None:
        # Behind a space that reaches to infinity nothing lies: a random colour for each ray keeps the field from staying half transparent.
        behind = _random_colours(count, rng, m.device)
    if colour.shape[1] == 4:
        if m.settings.background_color == "random" or m.background is None:
            # Behind an object with alpha anything may lie: a random colour for each ray keeps the field from learning one.
            behind = _random_colours(count, rng, m.device)
        colour = colour[:, :3] * colour[:, 3:] + behind * (1 - colour[:, 3:])
    return RayBatch(origins, directions, near, far, offset, behind, colour, chosen)


def _random_colours(count: int, rng: np.random.Generator, device: torch.device) -> Tensor:
    return to_device(torch.from_numpy(rng.random((count, 3), np.float32)), device)
