"""Random sparse trees, and rays through and beside them."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from efficientnerf.asset.cascades import cascade_grids, cascades_of, nested
from efficientnerf.asset.tree import NerfTree, tree_from_voxels
from efficientnerf.geometry.cameras import Camera
from tests.efficientnerf.balls import pose

LOW = np.array([-0.7, 0.2, -1.1])


def random_tree(
    seed: int = 0, *, shape: tuple[int, int, int] = (4, 3, 5), brick: int = 3, degree: int = 1, share: float = 0.3, sigma: float = 30.0, **more: Any
) -> NerfTree:
    """About `share` of the cells own a brick, of which two thirds of the voxels are stored. Values are halves, as in a file."""
    rng = np.random.default_rng(seed)
    size = np.array(shape) * brick
    cells = rng.random(shape) < share
    stored = cells.repeat(brick, 0).repeat(brick, 1).repeat(brick, 2) & (rng.random(size) < 0.67)
    indices = rng.permutation(np.argwhere(stored))
    density = (sigma * rng.random(len(indices)) ** 2).astype(np.float16).astype(np.float32)
    sh = rng.normal(size=(len(indices), (degree + 1) ** 2, 3)).astype(np.float16).astype(np.float32)
    return tree_from_voxels(shape, 0.1, LOW, indices, density, sh, brick=brick, **more)


def uniform_tree(shape: tuple[int, int, int] = (4, 4, 4), *, brick: int = 4, voxel: float = 0.1, sigma: float = 5.0, logit: float = 0.7) -> NerfTree:
    """Every voxel stored, all alike."""
    indices = np.argwhere(np.ones(np.array(shape) * brick, bool))
    sh = np.full((len(indices), 1, 3), logit / 0.28209479177387814, np.float32)
    return tree_from_voxels(shape, voxel, LOW, indices, np.full(len(indices), sigma, np.float32), sh, brick=brick)


def random_cascades(seed: int = 0, *, count: int = 3, cells: int = 4, brick: int = 3, degree: int = 1, share: float = 0.25, **more: Any) -> NerfTree:
    """Nested random trees, each twice as wide as the one before, with an environment map."""
    rng = np.random.default_rng(seed)
    bounds = np.stack([LOW, LOW + cells * brick * 0.1])
    trees = []
    for shape, voxel, low in cascade_grids(bounds, 0.1, brick, count):
        one = random_tree(int(rng.integers(2**31)), shape=shape, brick=brick, degree=degree, share=share, sigma=30.0 * 0.1 / voxel)
        trees.append(replace(one, voxel=voxel, bounds_min=low, **more))
    return nested(trees, rng.integers(0, 256, (8, 16, 3)).astype(np.float32) / np.float32(255))


def rays_at(tree: NerfTree, count: int = 60, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions: from outside, from inside, along the axes, and past the tree, a quarter each."""
    rng = np.random.default_rng(seed)
    target = rng.uniform(tree.bounds_min, tree.bounds_max, (count, 3))
    directions = rng.normal(size=(count, 3))
    kind = np.arange(count) % 4
    axis = np.eye(3)[rng.integers(0, 3, count)] * rng.choice([-1.0, 1.0], (count, 1))
    directions = np.where((kind == 2)[:, None], axis, directions / np.linalg.norm(directions, axis=1, keepdims=True))
    origins = target - directions * np.where(kind == 1, 0.0, 4.0)[:, None]
    return np.where((kind == 3)[:, None], target + 3 * directions, origins), directions


def nested_rays(tree: NerfTree, count: int = 60, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions through all cascades: from outside, from cascade 0, from anywhere, and along an axis, a quarter each."""
    rng = np.random.default_rng(seed)
    bounds = cascades_of(tree)[-1].bounds(tree.brick)
    target, kind = rng.uniform(*bounds, (count, 3)), np.arange(count) % 4
    directions = rng.normal(size=(count, 3))
    axis = np.eye(3)[rng.integers(0, 3, count)] * rng.choice([-1.0, 1.0], (count, 1))
    directions = np.where((kind == 3)[:, None], axis, directions / np.linalg.norm(directions, axis=1, keepdims=True))
    origins = target - directions * np.where(kind == 2, 0.0, 2 * np.linalg.norm(bounds[1] - bounds[0]))[:, None]
    return np.where((kind == 1)[:, None], rng.uniform(tree.bounds_min, tree.bounds_max, (count, 3)), origins), directions


TREES = [(1, 0), (3, 1), (4, 2), (5, 3), (2, 4)]


def looking(tree: NerfTree, side: int = 20) -> Camera:
    at = pose(0.7, 0.4)
    at[:3, 3] += (tree.bounds_min + tree.bounds_max) / 2
    return Camera("view", side, side + 3, "SIMPLE_PINHOLE", (1.5 * side, side / 2, side / 2), at)


def tensors(*arrays: np.ndarray) -> list[torch.Tensor]:
    return [torch.from_numpy(a) for a in arrays]


def in_codes(tree: NerfTree, groups: tuple[int, ...], entries: int) -> NerfTree:
    """The tree with random codes in place of its harmonics."""
    from efficientnerf.asset.palettes import PaletteHarmonics

    rng, count = np.random.default_rng(0), len(tree.density_values)
    codes = rng.integers(entries, size=(count, len(groups))).astype(np.uint8 if entries <= 256 else np.uint16)
    palette = rng.normal(size=(entries, sum(groups), 3)).astype(np.float32)
    base, table = rng.integers(256, size=(count, 3)).astype(np.uint8), rng.normal(size=(256, 3)).astype(np.float32)
    return replace(tree, harmonics=PaletteHarmonics(base, table, codes, palette, groups))
