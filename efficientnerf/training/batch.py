"""The rays of a step, and the colours that they are to have. R rays."""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from efficientnerf.model import Model
from efficientnerf.training.device_pixels import DevicePixels, on_host
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.settings import TrainSettings

MIN_RAYS = 64


class DrawnRays(NamedTuple):
    """What the rays of a step are made from: arrays of the host, or tensors of a device."""

    pixel: Any  # (R,) int64 indices
    offset: Any  # (R,) float32 of samples in their intervals
    behind: Any = None  # (R, 3) float32 random colours behind the scene, where there are
    colour: Any = None  # (R, 3 or 4) uint8, where images are not on the device


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


def ray_count(settings: TrainSettings, samples_per_ray: float) -> int:
    """Rays of a step: as many as have about `train.sample_batch_size` samples."""
    if settings.sample_batch_size == "off":
        return settings.max_rays_per_batch
    return int(min(settings.max_rays_per_batch, max(MIN_RAYS, settings.sample_batch_size / samples_per_ray)))


def drawn_rays(m: Model, pixels: Pixels | DevicePixels, count: int, rng: np.random.Generator, *, crop: bool) -> DrawnRays:
    """`count` random pixels; with `crop`, of the middle of the images."""
    pixel, offset = pixels.choose(count, rng, middle=crop), rng.random(count, np.float32)
    behind, channels = None, on_host(pixels).images.shape[1]
    if m.space.reaches_infinity and m.background is None:
        # Behind a space that reaches to infinity nothing lies: a random colour for each ray keeps the field from staying half transparent.
        behind = rng.random((count, 3), np.float32)
    if channels == 4 and (m.settings.background_color == "random" or m.background is None):
        # Behind an object with alpha anything may lie: a random colour for each ray keeps the field from learning one.
        behind = rng.random((count, 3), np.float32)
    return DrawnRays(pixel, offset, behind, pixels.colours_to_send(pixel) if isinstance(pixels, DevicePixels) else None)


def ray_batch(m: Model, pixels: Pixels | DevicePixels, drawn: DrawnRays) -> RayBatch:
    """The rays of `drawn`, which is on the model's device."""
    if isinstance(pixels, DevicePixels):
        origins, directions, near, far, colour = pixels.bundle_at(drawn.pixel, drawn.colour)
    else:
        origins, directions, near, far, colour = (torch.as_tensor(a, device=m.device) for a in pixels.bundle(drawn.pixel.cpu().numpy()))
    behind = m.behind(directions) if drawn.behind is None else drawn.behind
    if colour.shape[1] == 4:
        colour = colour[:, :3] * colour[:, 3:] + behind * (1 - colour[:, 3:])
    return RayBatch(origins, directions, near, far, drawn.offset, behind, colour)
