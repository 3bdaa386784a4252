"""Density, normal and colour of a NerfTree at points, of the cascade that each belongs to. N points."""

import numpy as np

from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.numba.tree import queries


def density_at(tree: NerfTree, points: np.ndarray) -> np.ndarray:
    """Density at points (N, 3) of the world: (N,) float32, per unit of the frame."""
    return queries.density_at(tree, tree.frame.points(np.asarray(points, np.float64)))


def normal_at(tree: NerfTree, points: np.ndarray) -> np.ndarray:
    """Unit vectors down the density's gradient at points (N, 3); (N, 3) float32, zero where it is flat."""
    at = tree.frame.points(np.asarray(points, np.float64))
    return np.asarray(tree.frame.world_normals(at, queries.normal_at(tree, at).astype(np.float64)), np.float32)


def colour_at(tree: NerfTree, points: np.ndarray, directions: np.ndarray | None = None) -> np.ndarray:
    """sRGB colour at points (N, 3), seen along unit directions (N, 3), or its view-independent part: (N, 3) float32, 0 to 1. Grey where no voxel is stored."""
    return queries.colour_at(tree, tree.frame.points(np.asarray(points, np.float64)), directions)


def density_block(tree: NerfTree, low: tuple[int, int, int], high: tuple[int, int, int]) -> np.ndarray:
    """Density at the voxel centres low <= (i, j, k) < high of cascade 0: float32, zero outside of the grid and where nothing is stored."""
    low_a, high_a = np.asarray(low), np.asarray(high)
    if (high_a < low_a).any():
        raise ValueError(f"density_block from {tuple(low)} to {tuple(high)}: the upper corner lies below the lower one")
    axes = [np.arange(a, b) for a, b in zip(low_a, high_a, strict=True)]
    inside = [(a >= 0) & (a < n) for a, n in zip(axes, tree.resolution, strict=True)]
    out = np.zeros(tuple(high_a - low_a), np.float32)
    i, j, k = (a[m] for a, m in zip(axes, inside, strict=True))
    if not (len(i) and len(j) and len(k) and len(tree.density_values)):
        return out
    d = tree.brick
    brick = tree.brick_index[np.ix_(i // d, j // d, k // d)]
    local = ((i % d)[:, None, None] * d + (j % d)[:, None]) * d + (k % d)
    index = np.where(brick >= 0, tree.voxel_index[np.maximum(brick, 0), local], -1)
    out[np.ix_(*inside)] = np.where(index >= 0, tree.density_values[np.maximum(index, 0)], 0)
    return out
