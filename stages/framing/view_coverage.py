"""Where in the box photographs can tell how far away matter is: where at least two cameras look.

What a single photograph shows is explained as well by matter at any distance along its rays, so that training hangs it wherever it comes to rest first. In
the box, the density voxels of such places are closed for good, and what is seen there is learned where it can do no harm, as surroundings.

Cameras are asked for what they have in view, whatever stands between: a side of the subject that one photograph alone shows has its depth from the
outlines in all others, and stays.

3000 steps of the preset `preview`, one seed. *banana_photos*, 13 training photographs: something black at the edge of one became a scrap in the air over
the carpet, of 27,000 voxels of the asset, 21,000 of which no other has in view. With such places closed, 2.5 % of the box, it is gone, and held-back views
gained, since one of them had it before its lens: the network's from 26.7 to 27.6 dB, the asset's from 27.4 to 27.9. *lund_door_colmap*, 10 training
photographs, 12 % of the box: 26.3 and 26.4 dB, the asset 27.6 dB with and without, and 27.5 dB without the rim, up to a density voxel wide, that hung before
the wall where these were closed: so the bake looks at its own voxels once more. With three cameras rather than two, walls that two had shown well
enough hung before their place, at the edge of what three see. *still_life*, 31 photographs: nothing is closed, and the field has the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from efficientnerf.geometry.cameras import Camera
from stages.framing.scene_bounds import in_view

if TYPE_CHECKING:
    from efficientnerf.geometry.spaces import Space

MOST_SHARE = 4  # a fourth of the cameras is not few


def cells_below_min_views(space: Space, cameras: Sequence[Camera], min_views: int, side: int) -> np.ndarray:
    """(D, D, D) bool of the density voxels of a contracted space, D = `side`: those whose centre lies in the box, and in the pictures of fewer than
    `min_views` cameras. No more are asked for than a quarter of the cameras (rounded up), and none of a single camera."""
    centre = (np.arange(side) + 0.5) / side * (2 * space.reach) - space.reach  # contraction leaves the box as it is
    inside = np.flatnonzero(np.abs(centre) <= 1)
    out = np.zeros((side, side, side), bool)
    unit = np.stack(np.meshgrid(*(centre[inside],) * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    few = ~has_min_views(unit * space.half + space.centre, cameras, min_views)
    out[np.ix_(inside, inside, inside)] = few.reshape((len(inside),) * 3)
    return out


def has_min_views(points: np.ndarray, cameras: Sequence[Camera], min_views: int) -> np.ndarray:
    """(N,) bool: which points (N, 3) of the world lie in the pictures of as many cameras; see `cells_below_min_views` for how many."""
    needed = min(min_views, -(-len(cameras) // MOST_SHARE))
    count = np.zeros(len(points), np.int32)
    open_still = np.arange(len(points) if needed > 1 else 0)
    for n in spread_order(len(cameras)):
        count[open_still] += in_view(points[open_still], [cameras[n]])[0]
        open_still = open_still[count[open_still] < needed]
    return (count >= needed) | (needed < 2)


def spread_order(count: int) -> list[int]:
    """0 to count - 1, each as far from those before it as halving brings it: cameras side by side see the same places."""
    bits = max(1, (count - 1).bit_length())
    order = (int(f"{n:0{bits}b}"[::-1], 2) for n in range(2**bits))
    return [n for n in order if n < count]
