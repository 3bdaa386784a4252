"""View coverage: how many training views have a point in view.

What one photograph alone shows is explained by density at any distance along its rays. In unbounded scenes, the density voxels in the box that fewer
than `train.min_views` views have in view are masked; what these views show is learned in the contracted shell instead. Occlusion is not considered.
See docs/experiments/min-views.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from efficientnerf.geometry.cameras import Camera
from stages.framing.scene_bounds import in_view

if TYPE_CHECKING:
    from efficientnerf.geometry.spaces import Space

MAX_FRACTION = 4  # at most one in so many of the cameras (rounded up) is required


def cells_below_min_views(space: Space, cameras: Sequence[Camera], min_views: int, side: int) -> np.ndarray:
    """(D, D, D) bool of the density voxels of a contracted space, D = `side`: those in the box that `has_min_views` is false for."""
    centre = (np.arange(side) + 0.5) / side * (2 * space.reach) - space.reach  # contraction is the identity in the box
    inside = np.flatnonzero(np.abs(centre) <= 1)
    out = np.zeros((side, side, side), bool)
    unit = np.stack(np.meshgrid(*(centre[inside],) * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    few = ~has_min_views(unit * space.half + space.centre, cameras, min_views)
    out[np.ix_(inside, inside, inside)] = few.reshape((len(inside),) * 3)
    return out


def has_min_views(points: np.ndarray, cameras: Sequence[Camera], min_views: int) -> np.ndarray:
    """(N,) bool: which points (N, 3) of the world at least `min_views` cameras have in view, or a quarter of the cameras (rounded up) if that is less."""
    needed = min(min_views, -(-len(cameras) // MAX_FRACTION))
    count = np.zeros(len(points), np.int32)
    undecided = np.arange(len(points) if needed > 1 else 0)
    for n in bit_reversed_order(len(cameras)):
        count[undecided] += in_view(points[undecided], [cameras[n]])[0]
        undecided = undecided[count[undecided] < needed]
    return (count >= needed) | (needed < 2)


def bit_reversed_order(count: int) -> list[int]:
    """0 to count - 1 by reversed bits: neighbours in a sequence, whose views overlap, come late."""
    bits = max(1, (count - 1).bit_length())
    order = (int(f"{n:0{bits}b}"[::-1], 2) for n in range(2**bits))
    return [n for n in order if n < count]
