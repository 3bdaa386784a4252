"""Which tiles of the training images a tree is trained on: those whose rays may meet it. The others give no gradient. T tiles."""

import math

import numpy as np

from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.numba.tree.leaps import leaps
from efficientnerf.backends.numba.tree_training.hits import come_near
from efficientnerf.backends.pieces import pieces
from efficientnerf.training.patches import PatchGrid

MOST_MET = 0.9  # share of the tiles above which all are drawn


def tiles_met(tree: NerfTree, patches: PatchGrid) -> np.ndarray | None:
    """(T,) bool: tiles whose patches have a ray that meets a brick of the tree; some more, and none less. None: nearly all, or a tree where all rays do.

    A patch reaches as far from its tile's centre as its angle times the distance: cells within that of an occupied one count as occupied.
    """
    if tree.outer or tree.ndc is not None or not len(tree.voxel_index):
        return None
    corners = np.stack(np.meshgrid(*np.stack([tree.bounds_min, tree.bounds_max]).T, indexing="ij"), axis=-1).reshape(-1, 3)
    furthest = float(np.linalg.norm(patches.pixels.centre[:, None].astype(np.float64) - corners, axis=-1).max())
    cell = tree.voxel * tree.brick
    # Voxels beyond a brick's faces are interpolated up to half a voxel away; a patch may begin a side before its tile and be as long.
    reach = math.ceil((2 * patches.angle * furthest + tree.voxel) / cell)
    if reach > 255:
        return None
    leap = leaps(leaps(tree.brick_index >= 0) <= reach)

    met = np.empty(len(patches), bool)
    for part in pieces(len(patches), first=2**12):
        origins, directions = patches.pixels.bundle(patches.centres(np.arange(part.start, part.stop)))[:2]
        come_near((origins.astype(np.float64) - tree.bounds_min) / cell, directions.astype(np.float64), leap, met[part])
    return None if met.mean() > MOST_MET or not met.any() else met
