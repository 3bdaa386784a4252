"""Pivots and the fine samples in their intervals (EfficientNeRF, section 3.4), in plain torch. R rays, N samples."""

import torch
from torch import Tensor

from efficientnerf.geometry.spaces import Space
from efficientnerf.rendering.compositing import ray_of_sample
from efficientnerf.sampling.samples import Samples


def select_pivots(weight: Tensor, first: Tensor, threshold: float, max_pivots: int) -> Tensor:
    """Which coarse samples are pivotal: (N,) bool, those with a weight above `threshold`, the `max_pivots` heaviest of a ray.

    The cap bounds the work while densities are still spread out. The lowest weights are dropped, in training and in rendering alike; among equals the
    nearer is kept. (The authors' release drops a random subset.)
    """
    pivotal = weight > threshold
    ray = ray_of_sample(first, len(weight))
    order = torch.argsort(weight, descending=True, stable=True)
    order = order[torch.argsort(ray[order], stable=True)]  # ray by ray, heaviest first
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(order), device=weight.device) - first[ray[order]]
    return pivotal & (rank < max_pivots)


def pivotal_samples(space: Space, origins: Tensor, directions: Tensor, offset: Tensor, coarse: Samples, pivotal: Tensor, per_pivot: int) -> Samples:
    """The fine samples: `per_pivot` in each interval of a pivotal coarse sample.

    pivotal  (N,) bool, which coarse samples are pivotal (their weight exceeds epsilon)
    """
    ray = ray_of_sample(coarse.first, len(pivotal))[pivotal]
    part = torch.arange(per_pivot, device=origins.device)
    extent = (coarse.extent[pivotal] / per_pivot)[:, None].expand(-1, per_pivot)
    start = coarse.start[pivotal][:, None] + part * extent
    length = (coarse.length[pivotal] / per_pivot)[:, None].expand(-1, per_pivot)
    at = start + offset[ray][:, None] * extent
    point = space.grid(origins[ray][:, None] + at[..., None] * directions[ray][:, None])
    per_ray = torch.zeros(len(origins), dtype=torch.int64, device=origins.device).index_add(0, ray, torch.full_like(ray, per_pivot))
    first = torch.cat([per_ray.new_zeros(1), per_ray.cumsum(dim=0)])
    return Samples(first, start.reshape(-1), extent.reshape(-1), length.reshape(-1), point.reshape(-1, 3), coarse.tried)
