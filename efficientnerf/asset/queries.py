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
    out, d = np.zeros(np.subtract(high, low), np.float32), tree.brick
    begin, end = (np.clip(corner, 0, tree.resolution) for corner in (low, high))  # inside of the grid
    first = begin // d
    brick = tree.brick_index[_box(first, -(-end // d))]  # (X, Y, Z)
    index = tree.voxel_index[brick[brick >= 0]]  # (B, d^3)
    if (end > begin).all() and len(index):
        bricks = np.zeros((*brick.shape, d**3), np.float32)
        bricks[brick >= 0] = np.where(index >= 0, tree.density_values[np.maximum(index, 0)], 0)
        voxels = bricks.reshape(*brick.shape, d, d, d).transpose(0, 3, 1, 4, 2, 5).reshape(np.multiply(brick.shape, d))
        out[_box(begin - low, end - low)] = voxels[_box(begin - first * d, end - first * d)]
    return out


def _box(low: np.ndarray, high: np.ndarray) -> tuple[slice, ...]:
    return tuple(slice(a, b) for a, b in zip(low.tolist(), high.tolist(), strict=True))
