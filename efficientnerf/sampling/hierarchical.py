"""NeRF's samples: stratified ones, and others drawn in proportion to the weights of these (Mildenhall et al. 2020, "NeRF", section 5.2). R rays, S stratified
samples a ray, F drawn on each, N samples."""

import torch
from torch import Tensor

from efficientnerf.geometry.spaces import Space
from efficientnerf.rendering.compositing import ray_of_sample
from efficientnerf.sampling.samples import Samples

IMPORTANCE_FLOOR = 1e-5  # added to every weight, as in NeRF's code, so that a ray that meets nothing is sampled evenly


def stratified_samples(
    space: Space, origins: Tensor, directions: Tensor, near: Tensor, far: Tensor, jitter: Tensor, *, outside: bool, capacity: int | None = None
) -> tuple[Samples, Tensor]:
    """NeRF's coarse samples: one in each of S equal intervals between near and far (Mildenhall et al. 2020, equation 2), and their distances (N,).

    near, far  (R,) distances; a ray whose far is not beyond its near gets none
    jitter     (R, S) in [0, 1), where in its interval each sample lies
    outside    whether samples outside of the space are kept (a network can be evaluated there, a hash grid cannot)
    capacity   see `efficientnerf.sampling.samples`; where all samples are kept and fit, there is no padding
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
    size = min(capacity, kept.numel())
    place = torch.cumsum(kept.reshape(-1), dim=0) - 1
    place = torch.where(kept.reshape(-1), place, size).clamp(max=size)  # samples that are left out or do not fit go to one place behind the others

    def placed(column: Tensor) -> Tensor:
        flat = column.reshape(kept.numel(), *column.shape[2:])
        return flat.new_zeros(size + 1, *flat.shape[1:]).index_put((place,), flat)[:size]

    start, extent, point, at = (placed(column) for column in (start, extent, point, at))
    return Samples(first.clamp(max=size), start, extent, extent, point, kept.numel(), first[1:] <= size), at


def importance_samples(
    space: Space, origins: Tensor, directions: Tensor, coarse: Samples, at: Tensor, weight: Tensor, quantile: Tensor, capacity: int | None = None
) -> Samples:
    """NeRF's fine samples: F drawn in proportion to the coarse weights, united with the coarse ones (Mildenhall et al. 2020, section 5.2).

        p_i = (w_i + 1e-5) / sum_j (w_j + 1e-5),  t = CDF^-1(quantile), p constant over each coarse interval

    Every interval is then divided among the samples in it, halfway between neighbours, so that their lengths sum to its own: a sample next to
    pruned ones does not reach across the gap. (NeRF gives each sample the distance to the next and the last one 1e10.)

    at        (N,) distance of each coarse sample
    weight    (N,) of each coarse sample, without gradient
    quantile  (R, F) in [0, 1]; rays without coarse samples get none
    capacity  see `efficientnerf.sampling.samples`; no padding where all samples fit, none is in `coarse`, and all rays have coarse samples
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
