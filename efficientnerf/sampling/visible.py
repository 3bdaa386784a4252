"""Samples that a ray reaches, in plain torch. N samples."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from efficientnerf.rendering.compositing import activate, ray_of_sample
from efficientnerf.sampling.samples import Samples


def visible_samples(samples: Samples, density: Callable[[Tensor], Tensor], activation: str, least: float) -> Samples:
    """The samples before which more than `least` of their ray's light is left: the first ones of each ray.

    density  of points (N, 3): (N,), before its activation
    """
    ray = ray_of_sample(samples.first, len(samples.start))
    depth = activate(density(samples.point), activation).double() * samples.length
    before = torch.cumsum(depth, dim=0) - depth
    begins = torch.cat([before, before.new_zeros(1)])[samples.first[:-1]]  # of a ray without samples, whatever lies there
    visible = before - begins[ray] < -math.log(least)
    total = torch.cat([samples.first.new_zeros(1), torch.cumsum(visible, dim=0)])
    return samples._replace(first=total[samples.first], **{name: getattr(samples, name)[visible] for name in ("start", "extent", "length", "point")})
