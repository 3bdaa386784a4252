"""The foreground region of a tree: what of a whole scene is its subject, chosen when it is rendered or exported.

B bricks, N stored voxels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Region:
    """The foreground region, in the tree's frame, z up.

    bounds         (2, 3) least and greatest corner
    corner_radius  of the four vertical edges: 0 is a box, half of the shorter side a disc in plan
    fade           width of the band inside of its sides in which density fades to nothing
    bricks         (B,) bool, the bricks that belong to it; None: all
    """

    bounds: np.ndarray
    corner_radius: float = 0.0
    fade: float = 0.0
    bricks: np.ndarray | None = None
