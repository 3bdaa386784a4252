"""Updates of the density voxels in training: with the coarse field's densities on the rays of a step, and at random voxels now and then."""

import numpy as np
import torch
from torch import Tensor

from efficientnerf.backends import dispatch
from efficientnerf.model import Model, RayOutputs
from efficientnerf.rendering.compositing import activate
from efficientnerf.sampling.occupancy import apply_decay, cell_of, random_cells, reset_cells, sweep_cells, update

SWEEP_PARTS = 8  # updates of the warm-up that together query every voxel
BLOCK = 2**17  # voxels that are queried at a time


@torch.no_grad()
def update_on_rays(m: Model, outputs: RayOutputs, *, padded: bool) -> None:
    """The coarse densities on the rays of a step, whose samples may be `padded` to a capacity."""
    if m.prunes:
        update_at_points(m, outputs.coarse.point, outputs.coarse_raw[:, 0].detach(), count=outputs.coarse.first[-1] if padded else None)


@torch.no_grad()
def update_in_turn(m: Model, number: int, rng: np.random.Generator, *, empty: bool | None) -> None:
    """After step `number`: every `train.occupancy_update_interval` steps, the coarse densities in some voxels.

    empty  whether the step had no samples; None: on a device, which is not asked
    """
    if not m.prunes:
        return
    due = number % m.settings.occupancy_update_interval == 0
    if due:
        update_at_random_cells(m, number, rng)
    # No samples, no gradients: a scene whose voxels are all invalid would stay empty.
    if empty is None and due:
        reset_cells(m.voxels, ~(m.voxels.values > m.voxels.threshold).any())
    elif empty and not bool((m.voxels.values > m.voxels.threshold).any()):
        reset_cells(m.voxels)


def update_at_random_cells(m: Model, number: int, rng: np.random.Generator) -> None:
    """Decay the voxels, and query the coarse field at some of them: all in turn in the warm-up, then random ones."""
    seed = int(rng.integers(2**62))
    apply_decay(m.voxels)
    if m.settings.occupancy_update_fraction == 0:
        return
    if number <= m.settings.occupancy_warmup_steps:
        cell, point = sweep_cells(m.voxels, number // m.settings.occupancy_update_interval, SWEEP_PARTS, seed)
    else:
        cell, point = random_cells(m.voxels, int(m.settings.occupancy_update_fraction * m.voxels.side**3), seed)
    update_at_cells(m, cell, point)


def update_at_cells(m: Model, cell: Tensor, point: Tensor, block: int = BLOCK) -> None:
    """Query the coarse field at points (N, 3) in some voxels (N,), `block` at a time."""
    for begin in range(0, len(cell), block):
        part = point[begin : begin + block]
        update_at_points(m, part, m.coarse.density(m.snapped_points(part)), cell[begin : begin + block])


def update_at_points(m: Model, point: Tensor, raw: Tensor, cell: Tensor | None = None, count: Tensor | None = None) -> None:
    """Update the density voxels with raw densities (N,) at points (N, 3) in grid coordinates; `cell` (N,), where it is known, and `count` as for `update`."""
    if count is None and m.voxels.rule == "maximum":
        dispatch.update_occupancy_maximum(m.voxels.values, point, raw, m.coarse.activation, cell)
        return
    cell = cell_of(point, m.voxels.side) if cell is None else cell
    update(m.voxels, cell, raw if m.voxels.rule == "momentum" else activate(raw, m.coarse.activation), count)
