"""Valid samples: coarse samples where the density voxels are above their threshold (EfficientNeRF, section 3.3), in plain torch. R rays, N samples."""

import torch
from torch import Tensor

from efficientnerf.geometry.spaces import FARTHEST, Space
from efficientnerf.sampling.samples import Samples


def valid_samples(
    space: Space, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, offset: Tensor, step: float, max_intervals: int,
    voxels: Tensor, threshold: float, *, unpruned: int = 0,
) -> Samples:  # fmt: skip
    """The coarse samples of rays that lie where the density voxels are above `threshold` (equation 9).

    origins, directions  (R, 3) world frame, unit directions
    near, far, offset    (R,) distances, and the offset in [0, 1)
    step, max_intervals  length of an interval in the box (the last of a ray is cut short); intervals on a ray at most
    voxels               (D, D, D) density voxels over the grid coordinates
    unpruned             the first so many rays are not pruned
    """
    t, t_exit = space.clip(origins, directions, near, far)
    side = voxels.shape[0]
    columns = []
    tried = 0
    limit = torch.full_like(t, threshold)
    limit[:unpruned] = -torch.inf
    for _ in range(max_intervals):
        growth = torch.ones_like(t)  # of the interval, with the distance
        if space.contracted:
            norm = space.unit(origins + t[:, None] * directions).abs().amax(dim=-1).clamp(min=1)
            growth = norm * norm
            t_exit = torch.where(norm * FARTHEST > 1, t, t_exit)
        alive = t < t_exit
        if not alive.any():
            break
        extent = torch.minimum(step * growth, t_exit - t)  # the last interval ends where the ray leaves the space
        point = space.grid(origins + (t + offset * extent)[:, None] * directions)
        cell = (point * side).long().clamp(0, side - 1)
        valid = alive & (voxels[cell[:, 0], cell[:, 1], cell[:, 2]] > limit)
        tried += int(alive.sum())
        columns.append((valid, t, extent, extent / growth, point))
        t = t + step * growth
    if not columns:
        empty = origins.new_zeros(0)
        return Samples(torch.zeros(len(origins) + 1, dtype=torch.int64, device=origins.device), empty, empty, empty, empty.reshape(0, 3), 0)
    valid = torch.stack([c[0] for c in columns], dim=1)  # (R, S)
    start, extent, length = (torch.stack([c[n] for c in columns], dim=1)[valid] for n in (1, 2, 3))
    point = torch.stack([c[4] for c in columns], dim=1)[valid]
    first = torch.cat([valid.new_zeros(1, dtype=torch.int64), valid.sum(dim=1).cumsum(dim=0)])
    return Samples(first, start, extent, length, point, tried)
