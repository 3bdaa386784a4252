"""Where rays are sampled: valid samples (EfficientNeRF, section 3.3) and pivotal ones (section 3.4), in plain torch.

A ray is cut into intervals. In the box an interval is `step` long; beyond it, it grows with the square of the distance, which is the same
length in contracted space. A random offset in [0, 1), one per ray and shared by both stages, says where in its interval a sample lies.
Coarse sample i lies in interval i; a pivotal interval is cut into N_s slots, each with one fine sample, so that no point is evaluated twice
and neighbouring pivots do not overlap (the paper's equation 11 read literally gives overlapping neighbourhoods; see the authors' release).

R rays, N samples.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from efficientnerf.grid import Space
from efficientnerf.transfer import constant

FARTHEST = 1.0 / 64  # 1 / |u|_inf at which a ray in contracted space ends


class Samples(NamedTuple):
    """Packed samples of a bundle of rays.

    first   (R + 1,) int64 offsets: ray r owns samples first[r] to first[r + 1]
    start   (N,) where the sample's interval begins, distance along the ray
    extent  (N,) its length, world units
    length  (N,) its length in the field's units: the world's in the box, contracted beyond
    point   (N, 3) grid coordinates of the sample
    tried   how many samples there would have been without the density voxels
    """

    first: Tensor
    start: Tensor
    extent: Tensor
    length: Tensor
    point: Tensor
    tried: int


def clip_to_space(space: Space, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
    """Distances (R,) at which rays enter and leave the space, within near and far; leave <= enter where they miss it."""
    if space.contracted:
        return near, far
    u, du = space.unit(origins), directions / constant(space.half, directions)
    du = torch.where(du.abs() < 1e-12, torch.full_like(du, 1e-12), du)
    one, other = (-1 - u) / du, (1 - u) / du
    return torch.maximum(torch.minimum(one, other).amax(dim=-1), near), torch.minimum(torch.maximum(one, other).amin(dim=-1), far)


def valid_samples(
    space: Space, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, offset: Tensor, step: float, slots: int, voxels: Tensor, threshold: float
) -> Samples:
    """The coarse samples of rays that lie where the density voxels are above `threshold` (equation 9).

    origins, directions  (R, 3) world frame, unit directions
    near, far, offset    (R,) distances, and the offset in [0, 1)
    step, slots          length of an interval in the box (the last of a ray is cut short); at most so many intervals on a ray
    voxels               (D, D, D) density voxels over the grid coordinates
    """
    t, leave = clip_to_space(space, origins, directions, near, far)
    side = voxels.shape[0]
    columns = []
    tried = 0
    for _ in range(slots):
        stretch = torch.ones_like(t)
        if space.contracted:
            reach = space.unit(origins + t[:, None] * directions).abs().amax(dim=-1).clamp(min=1)
            stretch = reach * reach
            leave = torch.where(reach * FARTHEST > 1, t, leave)
        alive = t < leave
        if not alive.any():
            break
        extent = torch.minimum(step * stretch, leave - t)  # the last interval ends where the ray leaves
        point = space.grid(origins + (t + offset * extent)[:, None] * directions)
        cell = (point * side).long().clamp(0, side - 1)
        valid = alive & (voxels[cell[:, 0], cell[:, 1], cell[:, 2]] > threshold)
        tried += int(alive.sum())
        columns.append((valid, t, extent, extent / stretch, point))
        t = t + step * stretch
    if not columns:
        empty = origins.new_zeros(0)
        return Samples(torch.zeros(len(origins) + 1, dtype=torch.int64, device=origins.device), empty, empty, empty, empty.reshape(0, 3), 0)
    valid = torch.stack([c[0] for c in columns], dim=1)  # (R, slots)
    start, extent, length = (torch.stack([c[n] for c in columns], dim=1)[valid] for n in (1, 2, 3))
    point = torch.stack([c[4] for c in columns], dim=1)[valid]
    first = torch.cat([valid.new_zeros(1, dtype=torch.int64), valid.sum(dim=1).cumsum(dim=0)])
    return Samples(first, start, extent, length, point, tried)


def pivots(weight: Tensor, first: Tensor, threshold: float, most: int) -> Tensor:
    """Which coarse samples are pivotal: (N,) bool, those with a weight above `threshold`, the `most` heaviest of a ray.

    The cap bounds the work where a field is still fog. The lowest weights are dropped, in training and in rendering alike; among equals the
    nearer is kept. (The authors' release drops a random subset.)
    """
    pivotal = weight > threshold
    counts = first[1:] - first[:-1]
    ray = torch.repeat_interleave(torch.arange(len(counts), device=weight.device), counts, output_size=len(weight))
    order = torch.argsort(weight, descending=True, stable=True)
    order = order[torch.argsort(ray[order], stable=True)]  # ray by ray, heaviest first
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(order), device=weight.device) - first[ray[order]]
    return pivotal & (rank < most)


def pivotal_samples(space: Space, origins: Tensor, directions: Tensor, offset: Tensor, coarse: Samples, pivotal: Tensor, per_pivot: int) -> Samples:
    """The fine samples: `per_pivot` in each interval of a pivotal coarse sample.

    pivotal  (N,) bool, which coarse samples are pivotal (their weight exceeds epsilon)
    """
    rays = len(origins)
    counts = coarse.first[1:] - coarse.first[:-1]
    ray = torch.repeat_interleave(torch.arange(rays, device=origins.device), counts, output_size=len(pivotal))[pivotal]
    slot = torch.arange(per_pivot, device=origins.device)
    extent = (coarse.extent[pivotal] / per_pivot)[:, None].expand(-1, per_pivot)
    start = coarse.start[pivotal][:, None] + slot * extent
    length = (coarse.length[pivotal] / per_pivot)[:, None].expand(-1, per_pivot)
    at = start + offset[ray][:, None] * extent
    point = space.grid(origins[ray][:, None] + at[..., None] * directions[ray][:, None])
    per_ray = torch.zeros(rays, dtype=torch.int64, device=origins.device).index_add(0, ray, torch.full_like(ray, per_pivot))
    first = torch.cat([per_ray.new_zeros(1), per_ray.cumsum(dim=0)])
    return Samples(first, start.reshape(-1), extent.reshape(-1), length.reshape(-1), point.reshape(-1, 3), coarse.tried)


def stratified_samples(
    space: Space, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, jitter: Tensor, *, outside: bool
) -> tuple[Samples, Tensor]:
    """NeRF's coarse samples: one in each of S equal intervals between near and far (Mildenhall et al. 2020, equation 2), and their distances (N,).

    near, far  (R,) distances; a ray whose far is not beyond its near gets none
    jitter     (R, S) in [0, 1), where in its interval each sample lies
    outside    whether samples outside of the space are kept (a network can be asked there, a grid can't)
    """
    count = jitter.shape[1]
    extent = ((far - near) / count)[:, None].expand(-1, count)  # (R, S)
    start = near[:, None] + torch.arange(count, device=near.device) * extent
    at = start + jitter * extent
    point = space.grid(origins[:, None] + at[..., None] * directions[:, None])  # (R, S, 3)
    kept = extent > 0
    if not outside:
        kept = kept & ((point >= 0) & (point <= 1)).all(dim=-1)
    first = torch.cat([kept.new_zeros(1, dtype=torch.int64), kept.sum(dim=1).cumsum(dim=0)])
    return Samples(first, start[kept], extent[kept], extent[kept], point[kept], kept.numel()), at[kept]


IMPORTANCE_FLOOR = 1e-5  # added to every weight, as in NeRF's code, so that a ray that meets nothing is searched evenly


def importance_samples(
    space: Space, origins: Tensor, directions: Tensor, coarse: Samples, at: Tensor, weight: Tensor, quantile: Tensor
) -> Samples:
    """NeRF's fine samples: F drawn in proportion to the coarse weights, united with the coarse ones (Mildenhall et al. 2020, section 5.2).

        p_i = (w_i + 1e-5) / sum_j (w_j + 1e-5),  t = CDF^-1(quantile), p constant over each coarse interval

    Every interval is then divided among the samples in it, halfway between neighbours, so that their lengths sum to its own: a sample that pruning
    has left alone does not reach across the gap. (NeRF gives each sample the distance to the next and the last one 1e10; notes 4.)

    at        (N,) distance of each coarse sample
    weight    (N,) of each coarse sample, without gradient
    quantile  (R, F) in [0, 1]; rays without coarse samples get none
    """
    rays, drawn = quantile.shape
    counts = coarse.first[1:] - coarse.first[:-1]
    samples = len(at)
    if samples == 0:
        return coarse
    chance = weight.double() + IMPORTANCE_FLOOR
    total = torch.cumsum(chance, dim=0)
    padded = torch.cat([total.new_zeros(1), total])
    below, above = padded[coarse.first[:-1]], padded[coarse.first[1:]]
    hit = counts > 0
    target = (below[:, None] + quantile.double() * (above - below)[:, None])[hit]  # (H, F)
    low, high = coarse.first[:-1][hit][:, None], (coarse.first[1:] - 1)[hit][:, None]
    owner = torch.searchsorted(total, target).maximum(low).minimum(high)  # the interval that each falls into
    inside = ((target - padded[owner]) / chance[owner]).clamp(0, 1)
    fine_at = coarse.start[owner] + inside.to(at.dtype) * coarse.extent[owner]

    # Both kinds in order: by interval, then by distance.
    owner = torch.cat([torch.arange(samples, device=at.device), owner.reshape(-1)])
    t = torch.cat([at, fine_at.reshape(-1)])
    within = ((t - coarse.start[owner]) / coarse.extent[owner]).double().clamp(0, 1 - 1e-9)
    order = torch.argsort(owner + within, stable=True)
    owner, t = owner[order], t[order]
    end = coarse.start[owner] + coarse.extent[owner]
    same = owner[1:] == owner[:-1]
    middle = (t[1:] + t[:-1]) / 2
    right = torch.cat([torch.where(same, middle, end[:-1]), end[-1:]])
    left = torch.cat([coarse.start[owner[:1]], torch.where(same, middle, coarse.start[owner[1:]])])
    extent = right - left
    length = extent * (coarse.length[owner] / coarse.extent[owner])
    ray = torch.repeat_interleave(torch.arange(rays, device=at.device), counts, output_size=samples)[owner]
    point = space.grid(origins[ray] + t[:, None] * directions[ray])
    first = torch.cat([counts.new_zeros(1), (counts + drawn * hit).cumsum(dim=0)])
    return Samples(first, left, extent, length, point, coarse.tried)


def united(one: Samples, other: Samples) -> Samples:
    """The samples of one bundle of rays, then those of another."""
    first = torch.cat([one.first, other.first[1:] + one.first[-1]])
    pairs = ((one.start, other.start), (one.extent, other.extent), (one.length, other.length), (one.point, other.point))
    start, extent, length, point = (torch.cat(pair) for pair in pairs)
    return Samples(first, start, extent, length, point, one.tried + other.tried)
