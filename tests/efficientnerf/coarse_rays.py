"""Rays through density voxels, with coarse samples on them."""

from typing import NamedTuple

import numpy as np
import torch

from efficientnerf.geometry.spaces import Space, space_from
from efficientnerf.sampling import valid as valid_sampling
from efficientnerf.sampling.samples import Samples

BOUNDS = np.array([[-1.0, -0.5, -0.25], [1.0, 0.5, 0.75]])
STEP, SIDE = 0.11, 6


class Rays(NamedTuple):
    origins: torch.Tensor
    directions: torch.Tensor
    near: torch.Tensor
    far: torch.Tensor
    offset: torch.Tensor


def make_rays(kind: str, count: int = 60) -> Rays:
    rng = np.random.default_rng(len(kind))
    target = rng.uniform(BOUNDS[0], BOUNDS[1], (count, 3))
    away = rng.normal(size=(count, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    origins, directions = target + 3 * away, -away
    if kind == "inside":
        origins = target
    elif kind == "missing":
        directions = away
    elif kind == "parallel":  # to an axis, some through the box and some beside it
        directions = np.eye(3)[np.arange(count) % 3] * rng.choice([-1.0, 1.0], (count, 1))
        origins = np.where(directions == 0, target * rng.choice([1.0, 3.0], (count, 1)), -2 * directions)
    near, far = np.full(count, 0.05), rng.uniform(2.5, 6.0, count)
    return Rays(*(torch.from_numpy(a.astype(np.float32)) for a in (origins, directions, near, far, rng.random(count))))


def voxels_of(seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).random((SIDE, SIDE, SIDE)).astype(np.float32))


def coarse_samples_of(rays: Rays, contracted: bool) -> tuple[Space, Samples, torch.Tensor]:
    space = space_from(BOUNDS, contracted=contracted)
    coarse = valid_sampling.valid_samples(space, *rays, STEP, 60, voxels_of().to(rays.origins.dtype), 0.4)
    return space, coarse, torch.rand(len(coarse.start), generator=torch.Generator().manual_seed(0)) < 0.5
