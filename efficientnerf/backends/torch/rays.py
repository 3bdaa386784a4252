"""Rays of training pixels in plain torch."""

import torch
from torch import Tensor

from efficientnerf.backends.layout import PixelTables

LEAST_SLANT = 1e-3  # cosine between a ray and the view axis, at least


def pixel_rays(tables: PixelTables, stride: int, index: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Origins (R, 3), unit directions (R, 3), and near and far (R,) along the rays, in the world, of pixels (R,) of all views. Between the knots of `lookup`
    directions are interpolated."""
    t, view = tables, torch.searchsorted(tables.offsets, index, right=True) - 1
    pixel = index - t.offsets[view]
    row, column = pixel // t.width[view], pixel % t.width[view]
    at = t.lens[view] + row // stride * t.knots[view] + column // stride
    if stride == 1:
        local = t.lookup[at]
    else:
        f, g = (column % stride)[:, None] / stride, (row % stride)[:, None] / stride
        right, below = at + (f[:, 0] > 0), torch.where(g[:, 0] > 0, t.knots[view], 0)
        upper = (1 - f) * t.lookup[at] + f * t.lookup[right]
        lower = (1 - f) * t.lookup[at + below] + f * t.lookup[right + below]
        mixed = (1 - g) * upper + g * lower
        local = mixed / mixed.norm(dim=1, keepdim=True)
    directions = (t.rotation[view] * local[:, None]).sum(dim=2)
    slant = (directions * t.rotation[view, :, 2]).sum(dim=1).clamp(min=LEAST_SLANT)  # near and far are measured along the view axis
    return t.centre[view], directions, t.near[view] / slant, t.far[view] / slant
