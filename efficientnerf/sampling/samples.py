"""Where rays are sampled: valid samples (EfficientNeRF, section 3.3) and pivotal ones (section 3.4), in plain torch.

A ray is cut into intervals. In the box an interval is `step` long; beyond it, it grows with the square of the distance, which is the same
length in contracted space. A random offset in [0, 1), one per ray and shared by both stages, says where in its interval a sample lies.
Coarse sample i lies in interval i; a pivotal interval is cut into N_s slots, each with one fine sample, so that no point is evaluated twice
and neighbouring pivots do not overlap (the paper's equation 11 read literally gives overlapping neighbourhoods; see the authors' release).

How many samples a bundle has depends on values, and a host that asks a device for it waits. Functions that are given a `capacity` make arrays of that
many entries at most instead: `first` says how far they are filled, the rest is padding of length zero that belongs to no ray, and where a bundle has
more samples than fit its last rays lose theirs (`Samples.complete`).

R rays, N samples.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from efficientnerf.geometry.spaces import FARTHEST, Space
from efficientnerf.rendering.compositing import ray_of_sample


class Samples(NamedTuple):
    """Packed samples of a bundle of rays.

    first   (R + 1,) int64 offsets: ray r owns samples first[r] to first[r + 1]
    start   (N,) where the sample's interval begins, distance along the ray
    extent  (N,) its length, world units
    length  (N,) its length in the field's units: the world's in the box, contracted beyond
    point   (N, 3) grid coordinates of the sample
    tried   how many samples there would have been without the density voxels
    complete  (R,) bool, rays that found room for all of their samples; None: all did
    """

    first: Tensor
    start: Tensor
    extent: Tensor
    length: Tensor
    point: Tensor
    tried: int
    complete: Tensor | None = None


def valid_samples(
    space: Space, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, offset: Tensor, step: float, slots: int, voxels: Tensor, threshold: float,
    *, whole: int = 0,
) -> Samples:  # fmt: skip
    """The coarse samples of rays that lie where the density voxels are above `threshold` (equation 9).

    origins, directions  (R, 3) world frame, unit directions
    near, far, offset    (R,) distances, and the offset in [0, 1)
    step, slots          length of an interval in the box (the last of a ray is cut short); at most so many intervals on a ray
    voxels               (D, D, D) density voxels over the grid coordinates
    whole                so many rays at the beginning are sampled in every interval, whatever the voxels say
    """
    t, leave = space.clip(origins, directions, near, far)
    side = voxels.shape[0]
    columns = []
    tried = 0
    limit = torch.full_like(t, threshold)
    limit[:whole] = -torch.inf
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
        valid = alive & (voxels[cell[:, 0], cell[:, 1], cell[:, 2]] > limit)
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


def select_pivots(weight: Tensor, first: Tensor, threshold: float, most: int) -> Tensor:
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
    space: Space, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, jitter: Tensor, *, outside: bool, capacity: int | None = None
) -> tuple[Samples, Tensor]:
    """NeRF's coarse samples: one in each of S equal intervals between near and far (Mildenhall et al. 2020, equation 2), and their distances (N,).

    near, far  (R,) distances; a ray whose far is not beyond its near gets none
    jitter     (R, S) in [0, 1), where in its interval each sample lies
    outside    whether samples outside of the space are kept (a network can be asked there, a grid can't)
    capacity   see the module; where all samples are kept, and there is room, there is no padding
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
    if capacity is None:
        return Samples(first, start[kept], extent[kept], extent[kept], point[kept], kept.numel()), at[kept]
    room = min(capacity, kept.numel())
    place = torch.cumsum(kept.reshape(-1), dim=0) - 1
    place = torch.where(kept.reshape(-1), place, room).clamp(max=room)  # what is left out, or finds no room, goes to one place behind the others

    def placed(column: Tensor) -> Tensor:
        flat = column.reshape(kept.numel(), *column.shape[2:])
        return flat.new_zeros(room + 1, *flat.shape[1:]).index_put((place,), flat)[:room]

    start, extent, point, at = (placed(column) for column in (start, extent, point, at))
    return Samples(first.clamp(max=room), start, extent, extent, point, kept.numel(), first[1:] <= room), at


IMPORTANCE_FLOOR = 1e-5  # added to every weight, as in NeRF's code, so that a ray that meets nothing is searched evenly


def importance_samples(
    space: Space, origins: Tensor, directions: Tensor, coarse: Samples, at: Tensor, weight: Tensor, quantile: Tensor, capacity: int | None = None
) -> Samples:
    """NeRF's fine samples: F drawn in proportion to the coarse weights, united with the coarse ones (Mildenhall et al. 2020, section 5.2).

        p_i = (w_i + 1e-5) / sum_j (w_j + 1e-5),  t = CDF^-1(quantile), p constant over each coarse interval

    Every interval is then divided among the samples in it, halfway between neighbours, so that their lengths sum to its own: a sample that pruning
    has left alone does not reach across the gap. (NeRF gives each sample the distance to the next and the last one 1e10; notes 4.)

    at        (N,) distance of each coarse sample
    weight    (N,) of each coarse sample, without gradient
    quantile  (R, F) in [0, 1]; rays without coarse samples get none
    capacity  see the module; there is no padding where there is room, none in `coarse`, and all rays have coarse samples
    """
    drawn = quantile.shape[1]
    counts = coarse.first[1:] - coarse.first[:-1]
    samples = len(at)
    if samples == 0:
        return coarse
    chance = weight.double() + IMPORTANCE_FLOOR
    total = torch.cumsum(chance, dim=0)
    padded = torch.cat([total.new_zeros(1), total])
    below, above = padded[coarse.first[:-1]], padded[coarse.first[1:]]
    hit = counts > 0
    drawing = hit if capacity is None else slice(None)  # how many rays those are the host does not know
    target = (below[:, None] + quantile.double() * (above - below)[:, None])[drawing]  # (H, F)
    low, high = coarse.first[:-1][drawing][:, None], (coarse.first[1:] - 1)[drawing][:, None]
    owner = torch.searchsorted(total, target).maximum(low).minimum(high).clamp(min=0)  # the interval that each falls into
    inside = ((target - padded[owner]) / chance[owner]).clamp(0, 1)
    fine_at = coarse.start[owner] + inside.to(at.dtype) * coarse.extent[owner]

    # Both kinds in order: by interval, then by distance.
    owner = torch.cat([torch.arange(samples, device=at.device), owner.reshape(-1)])
    t = torch.cat([at, fine_at.reshape(-1)])
    within = ((t - coarse.start[owner]) / coarse.extent[owner]).double().clamp(0, 1 - 1e-9)
    first = torch.cat([counts.new_zeros(1), (counts + drawn * hit).cumsum(dim=0)])
    place = owner + within
    if capacity is not None:  # padding, and what was drawn for rays without samples, comes last
        real = torch.cat([torch.arange(samples, device=at.device) < coarse.first[-1], hit[:, None].expand(-1, drawn).reshape(-1)])
        place = torch.where(real, place, torch.inf)
    order = torch.argsort(place, stable=True)[:capacity]
    owner, t = owner[order], t[order]
    end = coarse.start[owner] + coarse.extent[owner]
    same = owner[1:] == owner[:-1]
    if capacity is not None:
        real = torch.arange(len(order), device=at.device) < first[-1]
        same = same & real[1:]
    middle = (t[1:] + t[:-1]) / 2
    right = torch.cat([torch.where(same, middle, end[:-1]), end[-1:]])
    left = torch.cat([coarse.start[owner[:1]], torch.where(same, middle, coarse.start[owner[1:]])])
    extent = right - left
    length = extent * (coarse.length[owner] / coarse.extent[owner])
    ray = ray_of_sample(coarse.first, samples)[owner]
    point = space.grid(origins[ray] + t[:, None] * directions[ray])
    if capacity is None:
        return Samples(first, left, extent, length, point, coarse.tried)
    left, extent, length = (torch.where(real, column, 0) for column in (left, extent, length))
    return Samples(first.clamp(max=len(order)), left, extent, length, torch.where(real[:, None], point, 0), coarse.tried, first[1:] <= len(order))
