"""What extracting a surface takes. docs/experiments/memory.md"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from stages.memory.need import SURFACES, Need, libraries
from stages.memory.rendering import tree_bytes

if TYPE_CHECKING:
    from efficientnerf.asset.tree import NerfTree

# Bytes. Of a stored voxel: vertices and faces while they are joined, cleaned and decimated, as many as a thin shell has; of a cell in which enclosed space
# is found, and of a voxel of the slab that these are made from; of a point with what its colour is looked up by.
VOXEL, CELL, SLAB_VOXEL, POINT = 150, 8, 6, 450


def surface_needed(tree: NerfTree, points: int = 0) -> Need:
    """What it takes to mesh a tree, and to spread so many points over the surface."""
    from efficientnerf.surface.isosurface import MOST_SLAB_VOXELS, pool_of
    from efficientnerf.surface.volume import volume_of

    pool = pool_of(volume_of(tree))
    cells = [-(-side // pool) + 2 for side in tree.resolution]
    slab = max(MOST_SLAB_VOXELS, pool**3 * cells[1] * cells[2])
    terms = {
        "vertices and faces": VOXEL * len(tree.density_values),
        "the grid": CELL * math.prod(cells) + SLAB_VOXEL * min(slab, math.prod(tree.resolution)),
        "the asset": tree_bytes(tree),
        "libraries": libraries() + SURFACES,
    }
    return Need(terms | ({"points": POINT * points} if points else {}))
