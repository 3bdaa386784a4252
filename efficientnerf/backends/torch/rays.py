"""Rays of training pixels in plain torch."""

from torch import Tensor, where


def ray_directions(lookup: Tensor, begin: Tensor, knots: Tensor, stride: int, pixel: Tensor, width: Tensor, rotation: Tensor, view: Tensor) -> Tensor:
    """Unit directions (R, 3) in the world of pixels, from a table of directions in the camera at every `stride`-th pixel, interpolated between.

    lookup    (K, 3) directions
    begin     (C,) first entry of each view in `lookup`; knots (C,) entries of a row
    pixel     (R,) row by row, of views (R,); width (C,) of images
    rotation  (C, 3, 3) camera to world
    """
    row, column = pixel // width[view], pixel % width[view]
    at = begin[view] + row // stride * knots[view] + column // stride
    if stride == 1:
        local = lookup[at]
    else:
        f, g = (column % stride)[:, None] / stride, (row % stride)[:, None] / stride
        right, below = at + (f[:, 0] > 0), where(g[:, 0] > 0, knots[view], 0)
        upper = (1 - f) * lookup[at] + f * lookup[right]
        lower = (1 - f) * lookup[at + below] + f * lookup[right + below]
        mixed = (1 - g) * upper + g * lower
        local = mixed / mixed.norm(dim=1, keepdim=True)
    return (rotation[view] * local[:, None]).sum(dim=2)
