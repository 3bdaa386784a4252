"""Supervision by the sparse points of structure from motion (Deng et al. 2022, "Depth-supervised NeRF", DS-NeRF). A rays to points."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from efficientnerf.backends import transfer
from efficientnerf.backends.transfer import to_device
from efficientnerf.model import UNSEEN, Model, RayOutputs
from efficientnerf.rendering.compositing import ray_of_sample
from efficientnerf.sampling.samples import Samples
from efficientnerf.training.losses import mean_over

# docs/experiments/losses.md
RAYS_PER_RAY = 8  # one ray to a sparse point for so many rays of pixels
WIDTH = 2.0  # coarse intervals on either side of a sparse point that count as at the point


@dataclass(frozen=True)
class SparseDepthRays:
    """Rays from training cameras to sparse points that are registered in their images."""

    # origins, directions: (A, 3) float32, unit directions
    origins: np.ndarray
    directions: np.ndarray
    distance: np.ndarray  # (A,) float32, to the point

    def __len__(self) -> int:
        return len(self.distance)


def sparse_depth_weight(weight: float, fraction: float) -> float:
    """The loss's weight at a fraction of the schedule: it falls to nothing by the half."""
    return weight * max(0.0, 1 - 2 * fraction)


class AimedRays(NamedTuple):
    """Rays that are aimed at sparse points: `bundle`, the arguments of `render_rays` as of `RayBatch`, and the distances of the points (A,)."""

    bundle: tuple[Tensor, ...]
    distance: Tensor


def aimed_rays(m: Model, rays: SparseDepthRays, count: int, rng: np.random.Generator) -> AimedRays:
    """`count` random rays to sparse points, from a tenth of their distance to four times it."""
    pick = rng.integers(len(rays), size=count)
    origins, directions, distance = (to_device(torch.from_numpy(a[pick]), m.device) for a in (rays.origins, rays.directions, rays.distance))
    offset = to_device(torch.from_numpy(rng.random(count, np.float32)), m.device)
    return AimedRays((origins, directions, 0.1 * distance, 4 * distance, offset, torch.full_like(directions, UNSEEN)), distance)


def sparse_depth_loss(outputs: RayOutputs, distance: Tensor, samples_per_pivot: int, complete: Tensor | None) -> Tensor:
    """The weight along the last rays of a rendered bundle that does not lie close to their sparse points, for both stages: 0 to 2.

        1 - sum_i w_i max(0, 1 - |t_i - d| / (WIDTH e_i))

    with t_i the middle of interval i, e_i its extent (of a coarse interval for both stages) and d the distance of the point. It removes floaters before
    the point.

    distance  (A,) of `AimedRays`, in the world
    complete  (R + A,) bool, rays that count; None: all
    """
    count, rays = len(distance), len(outputs.rays.near)
    distance = outputs.rays.last(count).frame_distance(distance)
    loss = distance.new_zeros(())
    for samples, weight, parts in ((outputs.coarse, outputs.coarse_weight, 1), (outputs.fine, outputs.fine_weight, samples_per_pivot)):
        start, extent, of_last, ray = _of_last(samples, weight, rays - count)
        off = (start + extent / 2 - distance[ray]).abs() / (WIDTH * parts * extent).clamp(min=1e-12)
        near = of_last * (1 - off).clamp(min=0)
        if complete is None:
            loss = loss + 1 - near.sum() / count
        else:
            loss = loss + mean_over(1 - near.new_zeros(count).index_add(0, ray, near), complete[-count:])
    return loss


def _of_last(samples: Samples, weight: Tensor, before: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Starts, extents and weights of the samples of all rays but the first `before`, and their rays, from 0. On a device, whose host would wait for their
    number, those of all rays, the others with a weight of zero."""
    if transfer.is_on_device(samples.first):
        ray = ray_of_sample(samples.first, len(samples.start)) - before
        return samples.start, samples.extent, torch.where(ray >= 0, weight, 0), ray.clamp(min=0)
    begin = int(samples.first[before])
    ray = ray_of_sample(samples.first[before:] - begin, len(samples.start) - begin)
    return samples.start[begin:], samples.extent[begin:], weight[begin:], ray
