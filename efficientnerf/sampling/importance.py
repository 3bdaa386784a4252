"""Importance samples: drawn in proportion to the weights of coarse samples (NeRF, section 5.2). R rays, F samples drawn on each, N coarse samples."""

import torch
from torch import Tensor

from efficientnerf.geometry.spaces import Space
from efficientnerf.rendering.compositing import ray_of_sample
from efficientnerf.sampling.samples import Samples

IMPORTANCE_FLOOR = 1e-5  # added to every weight, as in NeRF's code, so that a ray that meets nothing is sampled evenly


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
