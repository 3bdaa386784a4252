"""Supervision by the sparse points of structure from motion (Deng et al. 2022, "Depth-supervised NeRF", DS-NeRF). A rays to points."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from efficientnerf.backends import dispatch
from efficientnerf.model import UNSEEN, RayOutputs
from efficientnerf.training.losses import mean_over

# docs/experiments/losses.md
RAYS_PER_RAY = 8  # one ray to a sparse point for so many rays of pixels
POINTS_PER_SUPPORT_RAY = 4
WIDTH = 2.0  # coarse intervals on either side of a sparse point that count as at the point


@dataclass(frozen=True)
class SparseDepthRays:
    """Rays from training cameras to sparse points that are registered in their images."""

    # origins, directions: (A, 3) float32, unit directions
    origins: np.ndarray
    directions: np.ndarray
    distance: np.ndarray  # (A,) float32, to the point
    on_support: np.ndarray  # (A,) bool, those last: the point is on a plane that supports the subject, and something may stand before it
    planes: tuple[tuple[np.ndarray, float], ...] = ()  # on which those are: normals (3,), towards the subject, and offsets

    def __len__(self) -> int:
        return len(self.distance)


def sparse_depth_weight(weight: float, fraction: float) -> float:
    """The loss's weight at a fraction of the schedule: it falls to nothing by the half."""
    return weight * max(0.0, 1 - 2 * fraction)


class AimedRays(NamedTuple):
    """Rays that are aimed at sparse points: arrays of the host, or tensors of a device; fields as of `SparseDepthRays`."""

    origins: Any
    directions: Any
    distance: Any
    on_support: Any
    offset: Any  # (A,) float32 of samples in their intervals

    @property
    def bundle(self) -> tuple[Tensor, ...]:
        """The arguments of `render_rays`, of tensors: from a tenth of the points' distance to four times it."""
        return self.origins, self.directions, 0.1 * self.distance, 4 * self.distance, self.offset, torch.full_like(self.directions, UNSEEN)


def aimed_rays(rays: SparseDepthRays, count: int, rng: np.random.Generator) -> AimedRays:
    """`count` random rays to sparse points, and a quarter as many to the support, if there is one."""
    points = int(np.count_nonzero(~rays.on_support))
    pick = rng.integers(points, size=count)
    if points < len(rays):
        pick = np.concatenate([pick, rng.integers(points, len(rays), size=max(1, count // POINTS_PER_SUPPORT_RAY))])
        count = len(pick)
    return AimedRays(rays.origins[pick], rays.directions[pick], rays.distance[pick], rays.on_support[pick], rng.random(count, np.float32))


def sparse_depth_loss(outputs: RayOutputs, distance: Tensor, on_support: Tensor, samples_per_pivot: int, complete: Tensor | None) -> Tensor:
    """The weight along the last rays of a rendered bundle that does not lie close to their sparse points, for both stages: 0 to 2.

        1 - sum_i w_i max(0, 1 - |t_i - d| / (WIDTH e_i))

    with t_i the middle of interval i, e_i its extent (of a coarse interval for both stages) and d the distance of the point. It removes floaters before
    the point. Before a support there may be something: of a ray to it, what passes it counts of the light T that reaches it,

        T (1 - sum_i w_i / T)    over i with |t_i - d| < WIDTH e_i

    where the first T has no gradient: what stands before it stays as it is, and it becomes opaque where it is seen.

    distance, on_support  (A,) of `AimedRays`, in the world
    complete              (R + A,) bool, rays that count; None: all
    """
    distance = outputs.rays.last(len(distance)).frame_distance(distance)
    loss = distance.new_zeros(())
    for samples, weight, parts in ((outputs.coarse, outputs.coarse_weight, 1), (outputs.fine, outputs.fine_weight, samples_per_pivot)):
        each = dispatch.sparse_depth_errors(weight, samples.start, samples.extent, samples.first, distance, on_support, WIDTH * parts)
        loss = loss + (each.mean() if complete is None else mean_over(each, complete[-len(distance) :]))
    return loss
