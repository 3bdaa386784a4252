"""The foreground region of a tree: the subject of an unbounded scene, chosen when it is rendered or exported.

`foreground`, `surroundings` and `cropped` return a tree with less in it, which everything downstream takes as any other.

B bricks, N stored voxels.
"""

from dataclasses import replace

import numpy as np

from efficientnerf.asset.cascades import cascades_of, subset, voxel_cascades, voxel_coordinates, voxel_sides
from efficientnerf.asset.tree import NerfTree, Region
from efficientnerf.geometry.cameras import Similarity


def inside_distance(region: Region, points: np.ndarray) -> np.ndarray:
    """(N,) how far points (N, 3) of the tree's frame lie inside of the region's sides; negative outside."""
    bounds = np.asarray(region.bounds, np.float64)
    beyond = np.abs(np.asarray(points, np.float64) - bounds.mean(axis=0)) - (bounds[1] - bounds[0]) / 2  # (N, 3)
    radius = min(float(region.corner_radius), float((bounds[1] - bounds[0])[:2].min()) / 2)
    plan = beyond[:, :2] + radius
    across = np.linalg.norm(np.maximum(plan, 0), axis=1) + np.minimum(plan.max(axis=1), 0) - radius
    return np.asarray(-np.maximum(across, beyond[:, 2]))


def inside_share(region: Region, points: np.ndarray) -> np.ndarray:
    """(N,) how much of the opacity of voxels at points (N, 3) of the tree's frame belongs to the region's box: 1 inside of the band, 0 outside of its sides."""
    distance = inside_distance(region, points)
    if region.fade <= 0:
        return (distance > 0).astype(np.float64)
    share = np.clip(distance / region.fade, 0, 1)
    return np.asarray(share * share * (3 - 2 * share))


def voxel_centres(tree: NerfTree) -> np.ndarray:
    """(N, 3) float64 centres of the stored voxels of all cascades, in the tree's frame."""
    owner, cascades = voxel_cascades(tree), cascades_of(tree)
    low, side = np.stack([cascade.bounds_min for cascade in cascades]), np.array([cascade.voxel for cascade in cascades])
    return np.asarray(low[owner] + (voxel_coordinates(tree) + 0.5) * side[owner, None])


def foreground(tree: NerfTree) -> NerfTree:
    """The part of the tree in its region: no other voxels, opacity faded in the region's band, no environment, no outer cascades that would be
    empty. The result has no region: all of it is foreground. A tree without a region is returned as it is."""
    return tree if tree.region is None else _restricted(tree, _foreground_share(tree, tree.region))


def surroundings(tree: NerfTree, all_is_foreground: bool = False) -> NerfTree:
    """The part of the tree outside of its region: the rest of the opacity in the region's band, and the environment. Of a tree without a region, or if all
    is foreground, its environment alone."""
    share = np.zeros(len(tree.density_values)) if tree.region is None or all_is_foreground else 1 - _foreground_share(tree, tree.region)
    return replace(_restricted(tree, share), environment=tree.environment)


def _foreground_share(tree: NerfTree, region: Region) -> np.ndarray:
    """(N,) how much of the opacity of each voxel belongs to the tree's region."""
    share = inside_share(region, voxel_centres(tree))
    if region.bricks is not None:
        brick, local = np.nonzero(tree.voxel_index >= 0)
        share[tree.voxel_index[brick, local]] *= np.asarray(region.bricks, bool)[brick]
    return share


def cropped(tree: NerfTree, corners: np.ndarray, world_from_capture: Similarity) -> NerfTree:
    """The tree with the voxels alone whose centres lie in a box that is aligned with the axes of the capture's frame; no environment, no region.

    corners  (2, 3) opposite corners in the capture's frame, in any order

    Raises ValueError for a box without volume.
    """
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    if np.shape(corners) != (2, 3) or not np.isfinite(corners).all() or not (high > low).all():
        raise ValueError(f"box from {low.tolist()} to {high.tolist()}; expected two opposite corners of a box with some volume")
    points = tree.frame.world(voxel_centres(tree))
    with np.errstate(invalid="ignore"):  # at infinity, in normalised device coordinates
        at = world_from_capture.inverse().points(points)
        inside = (at >= low).all(axis=1) & (at <= high).all(axis=1)
    return _restricted(tree, inside.astype(np.float64))


def _restricted(tree: NerfTree, share: np.ndarray) -> NerfTree:
    """The tree with the opacity of its voxels, along a side, times `share` (N,); voxels without a share are dropped, those with all of it stay as they are."""
    kept = subset(replace(tree, region=None, environment=None), share > 0)
    occupied = [bool((cascade.brick_index >= 0).any()) for cascade in kept.outer]
    outer = kept.outer[: max((n + 1 for n, any_there in enumerate(occupied) if any_there), default=0)]
    part = share[share > 0]
    side = voxel_sides(kept)[part < 1].astype(np.float64)
    density = kept.density_values.copy()
    density[part < 1] = -np.log1p(part[part < 1] * np.expm1(-side * density[part < 1])) / side
    return replace(kept, outer=outer, density_values=density)
