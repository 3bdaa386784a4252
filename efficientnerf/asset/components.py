"""Small connected components of a tree: what the box cuts off from the rest of the scene, and floaters."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from efficientnerf.asset.tree import NerfTree

INTERIOR_RATIO = 0.01  # of `share`: the limit of components that reach no face of the grid


def small_components(tree: NerfTree, keep: np.ndarray, share: float) -> np.ndarray:
    """Which of the voxels `keep`, (N,) bool, belong to small connected components: (N,) bool.

    A component is made of coarse cells that hold such a voxel and touch, at a corner too. It is small with less than `share` of the largest
    one's voxels if it reaches a face of the grid, where the box may have cut it off, and with less than INTERIOR_RATIO of that elsewhere. In
    normalised device coordinates nothing lies beyond the far face, so that reaching a face means nothing.
    """
    from scipy import ndimage

    stored = tree.voxel_index >= 0
    stored[stored] = keep[tree.voxel_index[stored]]
    count_of = stored.sum(axis=1)
    if not len(count_of) or share <= 0:
        return np.zeros(len(keep), bool)
    brick = tree.brick_index.reshape(-1)
    cells = np.flatnonzero(brick >= 0)
    cells = cells[count_of[brick[cells]] > 0]
    occupied = np.zeros(tree.shape, bool)
    occupied.reshape(-1)[cells] = True
    labels, count = ndimage.label(occupied, structure=np.ones((3, 3, 3), bool))
    component_of = np.zeros(len(count_of), np.int64)
    component_of[brick[cells]] = labels.reshape(-1)[cells]
    voxels = np.bincount(component_of, weights=count_of, minlength=count + 1)
    at_face = np.zeros(count + 1, bool)
    if tree.ndc is None:
        for axis in range(3):
            for end in (0, -1):
                at_face[np.take(labels, end, axis=axis)] = True
    small = voxels < share * voxels.max() * np.where(at_face, 1.0, INTERIOR_RATIO)
    out = np.zeros(len(keep), bool)
    out[tree.voxel_index[stored]] = np.repeat(small[component_of], count_of)
    return out
