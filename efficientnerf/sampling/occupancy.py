"""Density voxels: a dense grid of the scene's density (EfficientNeRF, section 3.3), an occupancy grid in the words of instant-ngp.

Two rules of update, for the paper's equation 7 cannot be taken literally:

- "momentum" is equation 7 on the raw density, before its activation, with threshold 0. (A momentum average of densities >= 0 that starts at
  10 never reaches 0, so nothing would ever be pruned.)
- "maximum" keeps a decayed maximum of the density, v <- max(decay v, new), as instant-ngp does; a voxel is valid if its density has an alpha above a
  threshold over an interval. It needs far fewer updates.

Updates at random cells let pruned cells become valid again. Masked cells hold minus infinity, which no rule changes: they are never valid, not even
while nothing is pruned. docs/experiments/occupancy.md

D voxels a side, N samples.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from efficientnerf.backends import dispatch, transfer

POINTS_SEED = 1  # what differs between the seeds of random cells and of the points in them


@dataclass
class DensityVoxels:
    """values (D, D, D) float32 over grid coordinates, x slowest; a voxel is valid above `threshold`; `start` is the initial value."""

    values: Tensor
    rule: str
    beta: float
    decay: float
    threshold: float
    start: float

    @property
    def side(self) -> int:
        return self.values.shape[0]

    @property
    def occupied(self) -> float:
        """Fraction of valid voxels."""
        return int(self.count_occupied()) / self.values.numel()

    def count_occupied(self) -> Tensor:
        """Number of valid voxels, on their device."""
        return torch.count_nonzero(self.values > self.threshold)


def density_voxels(
    side: int, rule: str, *, initial: float = 10.0, beta: float = 0.1, decay: float = 0.95, threshold: float = 0.0, device: str = "cpu"
) -> DensityVoxels:
    """Fresh voxels; all are valid."""
    # A maximum that starts at twice the threshold decays below it after some fourteen updates, by when every cell has been queried.
    start = initial if rule == "momentum" else 2 * threshold
    return DensityVoxels(torch.full((side, side, side), start, device=device), rule, beta, decay, threshold, start)


def cell_of(points: Tensor, side: int) -> Tensor:
    """Flat index (N,) of the voxel that holds each point in grid coordinates (N, 3)."""
    cell = (points * side).long().clamp(0, side - 1)
    return (cell[:, 0] * side + cell[:, 1]) * side + cell[:, 2]


def update(voxels: DensityVoxels, cell: Tensor, density: Tensor, count: Tensor | None = None) -> None:
    """Update the voxels with the density at some cells, in place.

        momentum   V[i] <- (1 - beta) V[i] + beta mean(density in i)     equation 7; several samples in one voxel make one update
        maximum    V[i] <- max(V[i], max(density in i))

    cell     (N,) flat indices
    density  (N,) raw for "momentum", activated for "maximum"
    count    number on the device of the samples that are no padding; None: all
    """
    flat = voxels.values.view(-1)
    density = torch.where(torch.isneginf(flat[cell]), -torch.inf, density.to(flat.dtype))
    real = None if count is None else torch.arange(len(cell), device=flat.device) < count
    if voxels.rule == "maximum":
        density = density if real is None else torch.where(real, density, -torch.inf)
        flat.scatter_reduce_(0, cell, density, reduce="amax", include_self=True)
        return
    if real is not None or transfer.is_on_device(flat):
        _blend(flat, voxels.beta, cell, density, torch.ones_like(cell, dtype=torch.bool) if real is None else real)
        return
    seen, index, counts = torch.unique(cell, return_inverse=True, return_counts=True)
    mean = torch.zeros(len(seen), dtype=flat.dtype, device=flat.device).index_add_(0, index, density) / counts
    old = flat[seen]
    flat[seen] = torch.where(torch.isneginf(old), old, (1 - voxels.beta) * old + voxels.beta * mean)


def mask_cells(voxels: DensityVoxels, chosen: Tensor) -> None:
    """Make these voxels, (D, D, D) bool, invalid for good."""
    voxels.values.masked_fill_(chosen.to(voxels.values.device), -torch.inf)


def open_cells(voxels: DensityVoxels, chosen: Tensor) -> None:
    """Give those of these voxels, (D, D, D) bool, that are masked their initial value."""
    voxels.values.masked_fill_(chosen.to(voxels.values.device) & torch.isneginf(voxels.values), voxels.start)


def reset_cells(voxels: DensityVoxels, wanted: Tensor | None = None) -> None:
    """Set all voxels that are not masked to their initial value; only if `wanted`, a bool that may be on a device, is true."""
    kept = torch.isneginf(voxels.values)
    if wanted is not None:
        kept |= ~wanted
    voxels.values.copy_(torch.where(kept, voxels.values, voxels.start))


def _blend(flat: Tensor, beta: float, cell: Tensor, density: Tensor, real: Tensor) -> None:
    """Equation 7 without the number of different voxels, for which the host would wait: samples are sorted by voxel, and all of one voxel write the same
    value. Padding, (N,) ~real, is ignored."""
    if not len(cell):
        return
    cell, order = torch.sort(cell)
    group = torch.cumsum(torch.cat([cell.new_zeros(1), (cell[1:] != cell[:-1]).long()]), dim=0)
    counted, values = real[order], torch.where(real[order], density[order], 0)
    counts = flat.new_zeros(len(cell)).index_add(0, group, counted.to(flat.dtype))[group]
    mean = flat.new_zeros(len(cell)).index_add(0, group, values)[group] / counts.clamp(min=1)
    old = flat[cell]
    flat.index_put_((cell,), torch.where((counts > 0) & ~torch.isneginf(old), (1 - beta) * old + beta * mean, old))


MIN_DECAY = 1e-30  # in place of 0, which would make masked cells NaN


def apply_decay(voxels: DensityVoxels) -> None:
    """Under the rule "maximum": v <- decay v."""
    if voxels.rule == "maximum":
        voxels.values.mul_(max(voxels.decay, MIN_DECAY))


def sweep_cells(voxels: DensityVoxels, part: int, parts: int, seed: int) -> tuple[Tensor, Tensor]:
    """Every `parts`-th cell from the `part`-th on, and a random point in each."""
    cell = torch.arange(part % parts, voxels.side**3, parts, device=voxels.values.device)
    return cell, dispatch.points_in_cells(cell, voxels.side, seed)


def random_cells(voxels: DensityVoxels, count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Random cells (N,), half anywhere and half among the valid, and a random point in each (N, 3), grid coordinates."""
    cell = dispatch.random_cells(voxels.values, voxels.threshold, count, seed)
    return cell, dispatch.points_in_cells(cell, voxels.side, seed ^ POINTS_SEED)
