"""Smaller trees: fewer harmonics, larger voxels, or without voxels that cannot be seen.

N voxels, K harmonics, M samples along each side of a new voxel.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from efficientnerf.asset.palettes import PaletteHarmonics
from efficientnerf.asset.tree import NerfTree, tree_from_voxels, voxel_coordinates
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
    """The same grid box in larger voxels, `resolution` of them where the longest side has more now.

    A new voxel gets the density with the mean transmittance of the ones in its place, over the rays along the three axes that
    cross it; an average of densities would make a thin wall opaque all over its new voxel. Harmonics are averaged by opacity.
    """
    most = max(tree.resolution)
    if not 1 <= resolution <= most:
        raise ValueError(f"resolution {resolution} from an asset of {most} voxels along its longest side; expected 1 to {most}. Bake a finer one from its run.")
    ratio = most / resolution
    side = tree.voxel * ratio
    size = [max(1, math.ceil(round(n / ratio, 6))) for n in tree.resolution]
    x, y, z = (math.ceil(n / tree.brick) for n in size)
    at = voxel_coordinates(tree).astype(np.int64)
    # Every new voxel that a stored one reaches into.
    low = np.floor(at / ratio + 1e-9).astype(np.int64)
    high = np.ceil((at + 1) / ratio - 1e-9).astype(np.int64) - 1
    limit = np.array([x, y, z]) * tree.brick
    reached = np.concatenate([np.where(corner, high, low) for corner in np.argwhere(np.ones((2, 2, 2), bool))]) if len(at) else low
    flat = np.unique(np.ravel_multi_index(tuple(np.minimum(reached, limit - 1).T), tuple(limit))) if len(at) else np.zeros(0, np.int64)
    indices = np.stack(np.unravel_index(flat, tuple(limit)), axis=1).astype(np.int64)
    count = min(MOST_SAMPLES, int(ratio) if float(ratio).is_integer() else 2 * math.ceil(ratio))
    parts = [_merged(tree, block, ratio, count) for block in np.array_split(indices, 1 + len(indices) * count**3 // SAMPLES_AT_ONCE)]
    density, sh, known = (np.concatenate(values) for values in zip(*parts, strict=True))
    made = tree_from_voxels((x, y, z), side, tree.bounds_min, indices[known], density[known], sh[known], brick=tree.brick)
    changed = {name: getattr(made, name) for name in ("shape", "voxel", "brick_index", "voxel_index", "density_values", "harmonics")}
    return replace(tree, **changed)


def _merged(tree: NerfTree, indices: np.ndarray, ratio: float, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Density (n,) and harmonics (n, K, 3) of new voxels from `count`^3 points in each, and whether any of these met a stored voxel (n,)."""
    step = (np.arange(count) + 0.5) / count
    offset = np.stack(np.meshgrid(step, step, step, indexing="ij"), axis=-1)  # (M, M, M, 3)
    place = ((indices[:, None, None, None] + offset) * ratio).astype(np.int64)  # (n, M, M, M, 3)
    voxel = lookup(tree, place.reshape(-1, 3)).reshape(place.shape[:-1])
    known: np.ndarray = np.greater_equal(voxel, 0)
    density = np.where(known, tree.density_values[np.maximum(voxel, 0)], 0).astype(np.float64)
    side = tree.voxel * ratio
    transmittance = [np.exp(-density.mean(axis=axis) * side).mean(axis=(1, 2)) for axis in (1, 2, 3)]
    merged = -np.log(np.maximum(np.mean(transmittance, axis=0), 1e-30)) / side
    # Where nothing absorbs, what is stored has an equal say.
    share = np.where(known, -np.expm1(-density * tree.voxel) + 1e-6, 0).reshape(len(indices), count**3)
    share /= np.maximum(share.sum(axis=1, keepdims=True), 1e-12)
    sh = np.zeros((len(indices), tree.harmonics_count, 3), np.float32)
    for point in range(share.shape[1]):
        at = voxel.reshape(len(indices), count**3)[:, point]
        held = at >= 0
        sh[held] += share[held, point, None, None].astype(np.float32) * tree.coefficients(at[held])
    return merged.astype(np.float32), sh, np.asarray(known.reshape(len(indices), count**3).any(axis=1))


def pruned(tree: NerfTree) -> NerfTree:
    """Without the voxels that cannot be seen: those of density 0 among neighbours of density 0. Renders stay as they are."""
    at = voxel_coordinates(tree).astype(np.int64)
    lit: np.ndarray = np.greater(tree.density_values, 0)
    for offset in np.argwhere(np.ones((3, 3, 3), bool)) - 1:
        beside = lookup(tree, at + offset)
        lit = np.logical_or(lit, (beside >= 0) & (tree.density_values[np.maximum(beside, 0)] > 0))
    if lit.all():
        return tree
    left = tree_from_voxels(
        tree.shape, tree.voxel, tree.bounds_min, at[lit], tree.density_values[lit], np.zeros((int(lit.sum()), 1, 3), np.float32), brick=tree.brick
    )
    # tree_from_voxels sorts: the numbers of the voxels left, in its order.
    order = lookup(tree, voxel_coordinates(left).astype(np.int64))
    held = tree.harmonics
    harmonics = held.subset(order) if isinstance(held, PaletteHarmonics) else held[order]
    return replace(tree, brick_index=left.brick_index, voxel_index=left.voxel_index, density_values=left.density_values, harmonics=harmonics)


def lookup(tree: NerfTree, at: np.ndarray) -> np.ndarray:
    """Numbers (n,) of the stored voxels at coordinates (n, 3), -1 where none is."""
    inside: np.ndarray = ((at >= 0) & (at < np.asarray(tree.resolution))).all(axis=1)  # type: ignore[assignment]
    cell, local = np.divmod(np.where(inside[:, None], at, 0), tree.brick)
    owner = np.where(inside, tree.brick_index[tuple(cell.T)], -1)
    slot = (local[:, 0] * tree.brick + local[:, 1]) * tree.brick + local[:, 2]
    if not len(tree.voxel_index):
        return np.full(len(at), -1, np.int32)
    return np.where(owner >= 0, tree.voxel_index[np.maximum(owner, 0), slot], -1)
