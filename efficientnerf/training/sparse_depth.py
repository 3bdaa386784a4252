"""Supervision by the sparse points of structure from motion (Deng et al. 2022, "Depth-supervised NeRF", DS-NeRF). A rays to points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from efficientnerf.backends.transfer import to_device
from efficientnerf.model import Model, render_rays
from efficientnerf.rendering.compositing import ray_of_sample
from efficientnerf.sampling.samples import SampleCapacity, complete_rays
from efficientnerf.training.losses import mean_over

# docs/experiments/losses.md
RAYS_PER_RAY = 8  # one ray to a sparse point for so many rays of pixels
WIDTH = 2.0  # coarse intervals on either side of a sparse point that count as at the point


@dataclass(frozen=True)
class SparseDepthRays:
    """Rays from training cameras to sparse points that are registered in their images.

    origins, directions  (A, 3) float32, unit directions
    distance             (A,) float32, to the point
    """

    origins: np.ndarray
    directions: np.ndarray
    distance: np.ndarray

    def __len__(self) -> int:
        return len(self.distance)


def sparse_depth_weight(weight: float, fraction: float) -> float:
    """The loss's weight at a fraction of the schedule: it falls to nothing by the half."""
    return weight * max(0.0, 1 - 2 * fraction)


def sparse_depth_loss(
    m: Model, rays: SparseDepthRays, count: int, rng: np.random.Generator, *, prune: bool, capacity: SampleCapacity | None = None, samples_per_pivot: int = 0
) -> Tensor:
    """The weight along `count` random rays that does not lie close to their sparse points, for both stages: 0 to 2.

        1 - sum_i w_i max(0, 1 - |t_i - d| / (WIDTH e_i))

    with t_i the middle of interval i, e_i its extent (of a coarse interval for both stages) and d the distance of the point. It removes floaters before
    the point. prune, capacity, samples_per_pivot: see `render_rays`.
    """
    samples_per_pivot = samples_per_pivot or m.settings.samples_per_pivot
    pick = rng.integers(len(rays), size=count)
    origins, directions, distance = (to_device(torch.from_numpy(a[pick]), m.device) for a in (rays.origins, rays.directions, rays.distance))
    offset = to_device(torch.from_numpy(rng.random(count, np.float32)), m.device)
    bundle = (origins, directions, 0.1 * distance, 4 * distance, offset, m.behind(directions).detach())
    outputs = render_rays(m, *bundle, prune=prune, rng=rng, capacity=capacity, samples_per_pivot=samples_per_pivot)
    complete = complete_rays(outputs.coarse, outputs.fine)
    distance = outputs.rays.frame_distance(distance)
    loss = origins.new_zeros(())
    for samples, weight, parts in ((outputs.coarse, outputs.coarse_weight, 1), (outputs.fine, outputs.fine_weight, samples_per_pivot)):
        ray = ray_of_sample(samples.first, len(samples.start))
        off = (samples.start + samples.extent / 2 - distance[ray]).abs() / (WIDTH * parts * samples.extent).clamp(min=1e-12)
        near = weight * (1 - off).clamp(min=0)
        if complete is None:
            loss = loss + 1 - near.sum() / count
        else:
            loss = loss + mean_over(1 - near.new_zeros(count).index_add(0, ray, near), complete)
    return loss
