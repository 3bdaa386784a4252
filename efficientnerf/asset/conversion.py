"""Smaller trees: fewer harmonics, larger voxels, or without voxels that cannot be seen. N voxels, K harmonics, M samples along each side of a new voxel."""

import math
from dataclasses import replace

import numpy as np

from efficientnerf.asset.cascades import cascade_tree, cascades_of, nested, subset, voxel_cascades, voxel_coordinates, voxels_at
from efficientnerf.asset.palettes import PaletteHarmonics
from efficientnerf.asset.tree import NerfTree, Region, tree_from_voxels
from efficientnerf.rendering.harmonics import harmonics_count

SAMPLES_AT_ONCE = 2**20
MOST_SAMPLES = 16  # along a side


def with_degree(tree: NerfTree, degree: int) -> NerfTree:
    """The harmonics up to `degree` alone: they are orthonormal, so that this is the nearest in logits. Codes stay codes."""
    if not 0 <= degree <= tree.degree:
        raise ValueError(f"harmonics of degree {degree} from an asset of degree {tree.degree}; expected 0 to {tree.degree}")
    kept = harmonics_count(degree)
    held = tree.harmonics
    if not isinstance(held, PaletteHarmonics):
        return replace(tree, harmonics=np.ascontiguousarray(held[:, :kept]))
    groups, left = [], kept - 1
    for size in held.groups:
        groups.append(min(size, left))
        left -= groups[-1]
    groups = [size for size in groups if size]
    codes = np.ascontiguousarray(held.codes[:, : len(groups)])
    return replace(tree, harmonics=PaletteHarmonics(held.base, held.base_table, codes, np.ascontiguousarray(held.palette[:, : kept - 1]), tuple(groups)))


def with_resolution(tree: NerfTree, resolution: int) -> NerfTree:
    """The same grid box in larger voxels, `resolution` of them where the longest side has more now; that of cascade 0, where there are several.

    Cascades keep their coarse cells, whose faces each other's boxes lie on, so that their voxels get larger by the divisors of the brick alone, all alike.
    A new voxel gets the density with the mean transmittance of the ones in its place, over the rays along the three axes that
    cross it; an average of densities would make a thin wall opaque all over its new voxel. Harmonics are averaged by opacity.
    """
    most = max(tree.resolution)
    if not 1 <= resolution <= most:
        raise ValueError(f"resolution {resolution} from an asset of {most} voxels along its longest side; expected 1 to {most}. Bake a finer one from its run.")
    if not tree.outer:
        made = _enlarged(tree, most / resolution, tree.brick)
        return replace(made, region=_region_of(tree, made, most / resolution))
    divisor = most // resolution
    if most % resolution or tree.brick % divisor:
        possible = ", ".join(str(most // n) for n in range(1, tree.brick + 1) if tree.brick % n == 0)
        raise ValueError(f"resolution {resolution} from cascades of {most} voxels in bricks of {tree.brick}; expected one of {possible}")
    made = nested([_enlarged(cascade_tree(tree, n), divisor, tree.brick // divisor) for n in range(1 + len(tree.outer))], tree.environment)
    return replace(made, region=_region_of(tree, made, 1))


def _region_of(tree: NerfTree, made: NerfTree, ratio: float) -> Region | None:
    """The region of a tree for one whose coarse cells are `ratio` times as large: a brick belongs to it where one in its place did."""
    if tree.region is None or tree.region.bricks is None:
        return tree.region
    bricks = np.zeros(len(made.voxel_index), bool)
    for old, new in zip(cascades_of(tree), cascades_of(made), strict=True):
        owner = old.brick_index.reshape(-1)
        cells = np.flatnonzero(np.where(owner >= 0, tree.region.bricks[owner], False) if len(tree.region.bricks) else owner >= 0)
        at = np.stack(np.unravel_index(cells, old.shape), axis=-1)
        low, high = np.floor(at / ratio + 1e-9).astype(np.int64), np.ceil((at + 1) / ratio - 1e-9).astype(np.int64) - 1
        for corner in np.argwhere(np.ones((2, 2, 2), bool)):
            held = new.brick_index[tuple(np.minimum(np.where(corner, high, low), np.asarray(new.shape) - 1).T)]
            bricks[held[held >= 0]] = True
    return replace(tree.region, bricks=bricks)


def _enlarged(tree: NerfTree, ratio: float, brick: int) -> NerfTree:
    """One grid in voxels `ratio` times as large, in bricks of `brick`."""
    side = tree.voxel * ratio
    size = [max(1, math.ceil(round(n / ratio, 6))) for n in tree.resolution]
    x, y, z = (math.ceil(n / brick) for n in size)
    at = voxel_coordinates(tree).astype(np.int64)
    # Every new voxel that a stored one reaches into.
    low = np.floor(at / ratio + 1e-9).astype(np.int64)
    high = np.ceil((at + 1) / ratio - 1e-9).astype(np.int64) - 1
    limit = np.array([x, y, z]) * brick
    reached = np.concatenate([np.where(corner, high, low) for corner in np.argwhere(np.ones((2, 2, 2), bool))]) if len(at) else low
    flat = np.unique(np.ravel_multi_index(tuple(np.minimum(reached, limit - 1).T), tuple(limit))) if len(at) else np.zeros(0, np.int64)
    indices = np.stack(np.unravel_index(flat, tuple(limit)), axis=1).astype(np.int64)
    count = min(MOST_SAMPLES, int(ratio) if float(ratio).is_integer() else 2 * math.ceil(ratio))
    parts = [_merged(tree, block, ratio, count) for block in np.array_split(indices, 1 + len(indices) * count**3 // SAMPLES_AT_ONCE)]
    density, sh, known = (np.concatenate(values) for values in zip(*parts, strict=True))
    made = tree_from_voxels((x, y, z), side, tree.bounds_min, indices[known], density[known], sh[known], brick=brick)
    changed = {name: getattr(made, name) for name in ("shape", "brick", "voxel", "brick_index", "voxel_index", "density_values", "harmonics")}
    return replace(tree, **changed)


def _merged(tree: NerfTree, indices: np.ndarray, ratio: float, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Density (n,) and harmonics (n, K, 3) of new voxels from `count`^3 points in each, and whether any of these met a stored voxel (n,)."""
    step = (np.arange(count) + 0.5) / count
    offset = np.stack(np.meshgrid(step, step, step, indexing="ij"), axis=-1)  # (M, M, M, 3)
    place = ((indices[:, None, None, None] + offset) * ratio).astype(np.int64)  # (n, M, M, M, 3)
    voxel = voxels_at(tree, cascades_of(tree)[0], place)
    known: np.ndarray = np.greater_equal(voxel, 0)
    density = np.where(known, tree.density_values[np.maximum(voxel, 0)], 0).astype(np.float64)
    side = tree.voxel * ratio
    transmittance = [np.exp(-density.mean(axis=axis) * side).mean(axis=(1, 2)) for axis in (1, 2, 3)]
    merged = -np.log(np.maximum(np.mean(transmittance, axis=0), 1e-30)) / side
    # Where nothing absorbs, all stored voxels weigh the same.
    share = np.where(known, -np.expm1(-density * tree.voxel) + 1e-6, 0).reshape(len(indices), count**3)
    share /= np.maximum(share.sum(axis=1, keepdims=True), 1e-12)
    sh = np.zeros((len(indices), tree.harmonics_count, 3), np.float32)
    for point in range(share.shape[1]):
        at = voxel.reshape(len(indices), count**3)[:, point]
        held = at >= 0
        sh[held] += share[held, point, None, None].astype(np.float32) * tree.coefficients(at[held])
    return merged.astype(np.float32), sh, np.asarray(known.reshape(len(indices), count**3).any(axis=1))


def pruned(tree: NerfTree) -> NerfTree:
    """Without the voxels that cannot be seen: those of density 0 among neighbours of density 0 in their cascade. Renders stay as they are."""
    lit: np.ndarray = np.greater(tree.density_values, 0)
    at = voxel_coordinates(tree).astype(np.int64)
    member = voxel_cascades(tree) if tree.outer else np.zeros(len(lit), np.uint8)
    for n, cascade in enumerate(cascades_of(tree)):
        here = np.flatnonzero(member == n)
        for offset in np.argwhere(np.ones((3, 3, 3), bool)) - 1:
            beside = voxels_at(tree, cascade, at[here] + offset)
            lit[here] |= (beside >= 0) & (tree.density_values[np.maximum(beside, 0)] > 0)
    return tree if lit.all() else subset(tree, lit)
