"""Stratified samples: one in each of equal intervals (Mildenhall et al. 2020, "NeRF", equation 2). R rays, S samples a ray, N samples."""

import torch
from torch import Tensor

from efficientnerf.geometry.spaces import Space
from efficientnerf.sampling.samples import Samples


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
