"""Updates of the density voxels in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor

from efficientnerf.rendering.compositing import activate


def update_occupancy_maximum(values: Tensor, point: Tensor, raw: Tensor, activation: str) -> None:
    """V[i] <- max(V[i], activated density of the samples in voxel i), in place; masked voxels, which hold minus infinity, stay so.

    values  (D, D, D), contiguous
    point   (N, 3) grid coordinates, raw (N,) densities before their activation
    """
    side, flat = values.shape[0], values.view(-1)
    cell = (point * side).long().clamp(0, side - 1)
    place = (cell[:, 0] * side + cell[:, 1]) * side + cell[:, 2]
    density = activate(raw, activation).to(flat.dtype)
    flat.scatter_reduce_(0, place, torch.where(torch.isneginf(flat[place]), -torch.inf, density), reduce="amax", include_self=True)
