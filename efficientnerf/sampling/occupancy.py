"""Momentum density voxels: the memory of the density over the scene (EfficientNeRF, section 3.3).

Two readings of the paper, and two rules of update, are named settings, because the paper's own can't be taken literally:

- "momentum" is equation 7 on the raw density, before its activation, with threshold 0. (A momentum average of densities >= 0 that starts at
  10 never reaches 0, so nothing would ever be pruned.)
- "maximum" keeps a decayed maximum of the activated density, v <- max(decay v, new), and calls a voxel valid whose density would absorb more
  than about one percent of the light over an interval. It needs far fewer visits and heals itself.

With both, pruned space can come back: `refresh` asks the field about random cells. Voxels that are closed hold minus infinity, which no rule
changes: they are never valid, not even while nothing is pruned.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from efficientnerf.backends import transfer
from efficientnerf.backends.transfer import to_device


@dataclass
class DensityVoxels:
    """values (D, D, D) float32 over grid coordinates, x slowest; `start` is what they began with."""

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
        """Share of valid voxels."""
        return int(self.count_occupied()) / self.values.numel()

    def count_occupied(self) -> Tensor:
        """Number of valid voxels, where they lie."""
        return torch.count_nonzero(self.values > self.threshold)


def density_voxels(
    side: int, rule: str, *, initial: float = 10.0, beta: float = 0.1, decay: float = 0.95, threshold: float = 0.0, device: str = "cpu"
) -> DensityVoxels:
    """Fresh voxels; all are valid."""
    if rule not in ("momentum", "maximum"):
        raise ValueError(f"density voxels updated by {rule!r}: expected 'momentum' or 'maximum'")
    # A maximum that starts at twice the threshold is forgotten after some fourteen refreshes at the usual decay, and each cell has been asked by then.
    start = initial if rule == "momentum" else 2 * threshold
    return DensityVoxels(torch.full((side, side, side), start, device=device), rule, beta, decay, threshold, start)


def cell_of(points: Tensor, side: int) -> Tensor:
    """Flat index (N,) of the voxel that holds each point in grid coordinates (N, 3)."""
    cell = (points * side).long().clamp(0, side - 1)
    return (cell[:, 0] * side + cell[:, 1]) * side + cell[:, 2]


def update(voxels: DensityVoxels, cell: Tensor, density: Tensor, count: Tensor | None = None) -> None:
    """Tell the voxels the density at some cells, in place.

        momentum   V[i] <- (1 - beta) V[i] + beta mean(density in i)     equation 7; several samples in one voxel make one update
        maximum    V[i] <- max(V[i], max(density in i))

    cell (N,) flat indices, density (N,): raw for "momentum", activated for "maximum"; count, a number of the device: only so many are meant, and what
    follows is padding.
    """
    flat = voxels.values.view(-1)
    density = torch.where(torch.isneginf(flat[cell]), -torch.inf, density.to(flat.dtype))
    real = None if count is None else torch.arange(len(cell), device=flat.device) < count
    if voxels.rule == "maximum":
        density = density if real is None else torch.where(real, density, -torch.inf)
        flat.scatter_reduce_(0, cell, density, reduce="amax", include_self=True)
        return
    if real is not None or transfer.remote(flat):
        _blend(flat, voxels.beta, cell, density, torch.ones_like(cell, dtype=torch.bool) if real is None else real)
        return
    seen, index, counts = torch.unique(cell, return_inverse=True, return_counts=True)
    mean = torch.zeros(len(seen), dtype=flat.dtype, device=flat.device).index_add_(0, index, density) / counts
    old = flat[seen]
    flat[seen] = torch.where(torch.isneginf(old), old, (1 - voxels.beta) * old + voxels.beta * mean)


def mask_cells(voxels: DensityVoxels, chosen: Tensor) -> None:
    """No matter may be in these voxels, (D, D, D) bool, from now on."""
    voxels.values.masked_fill_(chosen.to(voxels.values.device), -torch.inf)


def reset_cells(voxels: DensityVoxels, wanted: Tensor | None = None) -> None:
    """Have all voxels but the closed ones as they were at first; only if `wanted`, a bool that may lie on a device, says so."""
    as_they_are = torch.isneginf(voxels.values)
    if wanted is not None:
        as_they_are |= ~wanted
    voxels.values.copy_(torch.where(as_they_are, voxels.values, voxels.start))


def _blend(flat: Tensor, beta: float, cell: Tensor, density: Tensor, real: Tensor) -> None:
    """Equation 7 without finding out how many voxels were seen, for which the host would wait, and without touching others: samples of one voxel are
    brought together by sorting, and all of them write the same value. Padding (N,) ~real counts for nothing, and leaves values as they are."""
    if not len(cell):
        return
    cell, order = torch.sort(cell)
    group = torch.cumsum(torch.cat([cell.new_zeros(1), (cell[1:] != cell[:-1]).long()]), dim=0)
    counted, told = real[order], torch.where(real[order], density[order], 0)
    counts = flat.new_zeros(len(cell)).index_add(0, group, counted.to(flat.dtype))[group]
    mean = flat.new_zeros(len(cell)).index_add(0, group, told)[group] / counts.clamp(min=1)
    old = flat[cell]
    flat.index_put_((cell,), torch.where((counts > 0) & ~torch.isneginf(old), (1 - beta) * old + beta * mean, old))


LEAST_DECAY = 1e-30  # nothing is kept either, but what is closed stays so


def apply_decay(voxels: DensityVoxels) -> None:
    """Forget a little, where the rule is "maximum": v <- decay v."""
    if voxels.rule == "maximum":
        voxels.values.mul_(max(voxels.decay, LEAST_DECAY))


def sweep_cells(voxels: DensityVoxels, part: int, parts: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Every `parts`-th cell from the `part`-th on, and a random point in each: the warm-up asks about every cell this way."""
    cell = torch.arange(part % parts, voxels.side**3, parts, device=voxels.values.device)
    return cell, _point_in(cell, voxels.side, generator)


def _point_in(cell: Tensor, side: int, generator: torch.Generator) -> Tensor:
    corner = torch.stack([cell // (side * side), cell // side % side, cell % side], dim=1)
    return (corner + to_device(torch.rand(len(cell), 3, generator=generator), cell.device)) / side


def _chosen_on_device(valid: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """(count,) cells, half anywhere and half among the valid (D^3,), wherever there are any; how many there are stays on the device."""
    chance = to_device(torch.rand(count, generator=generator, dtype=torch.float64), valid.device)
    anywhere = (chance * len(valid)).long()
    before = torch.cumsum(valid, dim=0)
    among = torch.searchsorted(before, (chance * before[-1]).long(), right=True).clamp(max=len(valid) - 1)
    turn = torch.arange(count, device=valid.device) % 2 == 0
    return torch.where(turn | (before[-1] == 0), anywhere, among)


def random_cells(voxels: DensityVoxels, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Cells to ask about anew, half anywhere and half among the valid, and a random point in each: (count,), (count, 3) grid coordinates."""
    flat = voxels.values.view(-1)
    if transfer.remote(flat):
        cell = _chosen_on_device(flat > voxels.threshold, count, generator)
        return cell, _point_in(cell, voxels.side, generator)
    anywhere = torch.randint(len(flat), (count - count // 2,), generator=generator).to(flat.device)
    valid = torch.nonzero(flat > voxels.threshold).squeeze(1)
    pick = torch.randint(max(len(valid), 1), (count // 2,), generator=generator).to(flat.device)
    cell = torch.cat([anywhere, valid[pick]]) if len(valid) else anywhere
    return cell, _point_in(cell, voxels.side, generator)
