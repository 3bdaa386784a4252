"""Small connected components of a tree: parts that the box cuts off from the scene, and floaters. N voxels."""

import numpy as np
from scipy import ndimage

from efficientnerf.asset.cascades import cascades_of, point_cascades, voxel_sides
from efficientnerf.asset.field_samples import FieldSamples
from efficientnerf.asset.region import inside_share, voxel_centres
from efficientnerf.asset.tree import NerfTree

INTERIOR_RATIO = 0.01  # of `share`: the limit of components that reach no face of the grid


def small_components(tree: NerfTree, keep: np.ndarray, share: float) -> np.ndarray:
    """Which of the voxels `keep`, (N,) bool, belong to small connected components: (N,) bool.

    A component is made of coarse cells that hold such a voxel and touch, at a corner too. It is small with less than `share` of the largest
    one's voxels if it reaches a face of the grid, where the box may have cut it off, and with less than INTERIOR_RATIO of that elsewhere. In
    normalised device coordinates nothing lies beyond the far face, so that reaching a face means nothing.
    """
    out = np.zeros(len(keep), bool)
    labels, voxels, cells = _label(tree, tree.brick_index, keep)
    if share <= 0 or not len(cells):
        return out
    at_face = np.zeros(len(voxels), bool)
    if tree.ndc is None:
        for axis in range(3):
            for end in (0, -1):
                at_face[np.take(labels, end, axis=axis)] = True
    small = voxels < share * voxels.max() * np.where(at_face, 1.0, INTERIOR_RATIO)
    rows = tree.voxel_index[tree.brick_index.reshape(-1)[cells[small[labels.reshape(-1)[cells]]]]]
    out[rows[rows >= 0]] = True
    return out & keep


FOREGROUND_SHARE = 0.005  # of the largest component's voxels: smaller ones are no part of the foreground
MIN_THICKNESS = 0.05  # optical thickness of a voxel from which it joins its neighbours to a component


def foreground_bricks(tree: NerfTree) -> np.ndarray:
    """The foreground's bricks, (B,) bool, for `Region.bricks`: in the innermost cascade those of its large components of voxels thick enough to show
    in the region, and the bricks around them; all bricks of the other cascades."""
    if tree.region is None:
        return np.ones(len(tree.voxel_index), bool)
    keep = (inside_share(tree.region, voxel_centres(tree)) > 0) & (tree.density_values * voxel_sides(tree) > MIN_THICKNESS)
    out = np.ones(len(tree.voxel_index), bool)
    labels, voxels, cells = _label(tree, tree.brick_index, keep)
    if len(cells):  # else nothing shows there, and all bricks stay
        large = voxels >= FOREGROUND_SHARE * voxels.max()
        large[0] = False
        near = ndimage.binary_dilation(large[labels], structure=np.ones((3, 3, 3), bool))
        own = tree.brick_index.reshape(-1)
        owned = np.flatnonzero(own >= 0)
        out[own[owned]] = near.reshape(-1)[owned]
    return out


MIN_SUPPORT = 3  # views whose rays end in a component, or all where there are fewer: a component that so many show is never dropped
SUPPORT_WEIGHT = 0.1  # of a sample that counts as its ray's end


def unsupported_components(tree: NerfTree, keep: np.ndarray, share: float, samples: FieldSamples) -> np.ndarray:
    """Which of the voxels `keep`, (N,) bool, of an unbounded scene belong to small components that fewer than MIN_SUPPORT views show: (N,) bool.

    Components are those of `small_components`, of each cascade by itself. Small is one in the innermost cascade, next to the cameras, with less than `share`
    of the voxels of the largest one, and in the others with less than INTERIOR_RATIO of that.
    """
    out = np.zeros(len(keep), bool)
    if share <= 0 or not keep.any():
        return out
    labelled = [_label(tree, cascade.brick_index, keep) for cascade in cascades_of(tree)]
    largest = max(float(voxels.max()) for _, voxels, _ in labelled)
    support = min(MIN_SUPPORT, len(samples.origin))
    views = _views_of_components(tree, [labels for labels, _, _ in labelled], [len(voxels) for _, voxels, _ in labelled], samples)
    for n, (labels, voxels, cells) in enumerate(labelled):
        small = (voxels < share * largest * (INTERIOR_RATIO if n else 1.0)) & (views[n] < support)
        rows = tree.voxel_index[cascades_of(tree)[n].brick_index.reshape(-1)[cells[small[labels.reshape(-1)[cells]]]]]
        out[rows[rows >= 0]] = True
    return out & keep


def _label(tree: NerfTree, brick_index: np.ndarray, keep: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The component of each coarse cell of a cascade, 0 where it holds no voxel that is kept; the voxels of each component; and the cells of any."""
    brick = brick_index.reshape(-1)
    cells = np.flatnonzero(brick >= 0)
    rows = tree.voxel_index[brick[cells]]
    count = ((rows >= 0) & keep[rows]).sum(axis=1)
    cells, count = cells[count > 0], count[count > 0]
    occupied = np.zeros(brick_index.shape, bool)
    occupied.reshape(-1)[cells] = True
    labels, components = ndimage.label(occupied, structure=np.ones((3, 3, 3), bool))
    return labels, np.bincount(labels.reshape(-1)[cells], weights=count, minlength=components + 1), cells


def _views_of_components(tree: NerfTree, labels: list[np.ndarray], counts: list[int], samples: FieldSamples) -> list[np.ndarray]:
    """How many views have rays that end in each component, of each cascade."""
    views = len(samples.origin)
    seen = [np.zeros(count * views, bool) for count in counts]
    for rays, part in samples.blocks():
        heavy = part.start + np.flatnonzero(samples.weight[part] >= SUPPORT_WEIGHT)
        ray = rays.start + np.searchsorted(samples.first[rays.start : rays.stop + 1], heavy, side="right") - 1
        points = samples.points(heavy, ray)
        which = point_cascades(tree, points)
        for n, cascade in enumerate(cascades_of(tree)):
            here = which == n
            cell = np.floor((points[here] - cascade.bounds_min) / (cascade.voxel * tree.brick)).astype(np.int64)
            cell = np.clip(cell, 0, np.asarray(cascade.shape) - 1)
            component = labels[n][cell[:, 0], cell[:, 1], cell[:, 2]].astype(np.int64)
            seen[n][component * views + samples.view[ray[here]]] = True
    return [one.reshape(-1, views).sum(axis=1) for one in seen]
