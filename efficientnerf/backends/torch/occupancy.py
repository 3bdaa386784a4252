"""Updates of the density voxels, random cells, and points in cells, in plain torch. N samples, D voxels a side."""

import torch
from torch import Tensor

from efficientnerf.backends import transfer
from efficientnerf.backends.transfer import to_device
from efficientnerf.rendering.compositing import activate
from efficientnerf.sampling.occupancy import cell_of


def update_occupancy_maximum(values: Tensor, point: Tensor, raw: Tensor, activation: str, cell: Tensor | None = None) -> None:
    """V[i] <- max(V[i], activated density of the samples in voxel i), in place; masked voxels, which hold minus infinity, stay so.

    values  (D, D, D), contiguous
    point   (N, 3) grid coordinates, raw (N,) densities before their activation
    cell    (N,) flat indices of the voxels, where they are known
    """
    flat = values.view(-1)
    place = cell_of(point, values.shape[0]) if cell is None else cell.long()
    density = activate(raw, activation).to(flat.dtype)
    flat.scatter_reduce_(0, place, torch.where(torch.isneginf(flat[place]), -torch.inf, density), reduce="amax", include_self=True)


def random_cells(values: Tensor, threshold: float, count: int, seed: int) -> Tensor:
    """(count,) flat indices of random voxels: the first half, rounded up, among all, the others among the valid, each in a part of its own of them, in order.

    values  (D, D, D). On the CPU the second half is left out where no voxel is valid; on a device, whose host does not wait for their number, all are
            then among all voxels.
    """
    flat = values.view(-1)
    chance = torch.rand(count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    half = count - count // 2
    place = torch.cat([(torch.arange(half) + chance[:half]) / half, (torch.arange(count - half) + chance[half:]) / max(count - half, 1)])
    place = to_device(place, flat.device)
    anywhere = (place * len(flat)).long().clamp(max=len(flat) - 1)
    if transfer.is_on_device(flat):
        before = torch.cumsum(flat > threshold, dim=0)
        among = torch.searchsorted(before, (place * before[-1]).long(), right=True).clamp(max=len(flat) - 1)
        return torch.where((torch.arange(count, device=flat.device) < half) | (before[-1] == 0), anywhere, among)
    valid = torch.nonzero(flat > threshold).squeeze(1)
    if not len(valid):
        return anywhere[:half]
    return torch.cat([anywhere[:half], valid[(place[half:] * len(valid)).long().clamp(max=len(valid) - 1)]])


def points_in_cells(cell: Tensor, side: int, seed: int) -> Tensor:
    """A random point (N, 3), grid coordinates, in each of the cells (N,)."""
    within = to_device(torch.rand(len(cell), 3, generator=torch.Generator().manual_seed(seed)), cell.device)
    return (torch.stack([cell // (side * side), cell // side % side, cell % side], dim=1) + within) / side
