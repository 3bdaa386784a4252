"""Pieces of a tree that hang apart from the rest: scraps of the surroundings that the box cuts off, and specks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from efficientnerf.asset.tree import NerfTree

SPECK = 0.01  # of `share`: a piece with less than that is left out wherever it hangs


def small_components(tree: NerfTree, keep: np.ndarray, share: float) -> np.ndarray:
    """Which of the stored voxels that are to be kept, (N,) bool, belong to scraps: (N,) bool.

    Coarse cells that hold a kept voxel and touch, at a corner too, are one piece: matter a coarse cell apart is apart. Scraps are pieces with less
    than `share` of the largest piece's voxels if they reach a face of the grid, where the box has cut them from something outside, and pieces
    with less than SPECK of that anywhere. In normalised device coordinates nothing lies beyond the far face, so that reaching a face says nothing.
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
    piece_of = np.zeros(len(count_of), np.int64)
    piece_of[brick[cells]] = labels.reshape(-1)[cells]
    voxels = np.bincount(piece_of, weights=count_of, minlength=count + 1)
    cut = np.zeros(count + 1, bool)
    if tree.ndc is None:
        for axis in range(3):
            for end in (0, -1):
                cut[np.take(labels, end, axis=axis)] = True
    scrap = voxels < share * voxels.max() * np.where(cut, 1.0, SPECK)
    out = np.zeros(len(keep), bool)
    out[tree.voxel_index[stored]] = np.repeat(scrap[piece_of], count_of)
    return out
