"""Splitting of voxels: from a tree to one of twice its resolution, as sparse voxel grids and octrees are refined.

Each chosen voxel gives way to its eight children, whose values are those that the tree has at their centres: density interpolated with nothing where no voxel
is stored, harmonics over the stored ones alone; with nearest lookup those of their parents. All cascades of a nested tree are split alike, so that they
stay nested.

Plenoxels (Fridovich-Keil et al. 2022) and SVRaster (Sun et al. 2025) refine their grids this way. N voxels, K harmonics.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from efficientnerf.asset.cascades import cascade_tree, cascades_of, nested, voxel_cascades, voxel_coordinates, voxels_around
from efficientnerf.asset.refinement.state import RefinementState
from efficientnerf.asset.tree import NerfTree, tree_from_voxels

_CORNERS = np.stack(np.meshgrid(*[np.arange(2)] * 3, indexing="ij"), axis=-1).reshape(8, 3)
PARENTS_PER_PIECE = 2**16


def split(state: RefinementState, keep: np.ndarray) -> RefinementState:
    """The state of a tree of twice the resolution with the children of the voxels `keep`, (N,) bool. Moments begin anew, the number of the step stays."""
    state.to_host()
    tree = split_tree(state.tree, keep)
    count = len(tree.density_values)
    return RefinementState(tree, np.zeros(count, np.float32), np.zeros(count, np.float32), np.zeros(count, np.int32), state.step, state.errors)


def split_tree(tree: NerfTree, keep: np.ndarray) -> NerfTree:
    """A tree of twice the resolution with the children of the voxels `keep`, (N,) bool."""
    cascades = voxel_cascades(tree)
    trees = [_split_grid(tree, keep, cascades == n, n) for n in range(len(cascades_of(tree)))]
    return replace(trees[0] if not tree.outer else nested(trees, tree.environment), region=tree.region)


def _split_grid(tree: NerfTree, keep: np.ndarray, here: np.ndarray, number: int) -> NerfTree:
    """Cascade `number`, whose voxels are `here`, as a split grid of its own."""
    grid = cascade_tree(tree, number) if tree.outer else tree
    chosen = keep[here]
    parents = voxel_coordinates(grid)[chosen]
    children = (2 * parents[:, None] + _CORNERS).reshape(-1, 3)
    if grid.lookup == "nearest":
        density, sh = grid.density_values[chosen].repeat(8), grid.sh[chosen].repeat(8, axis=0)
    else:
        density, sh = np.empty(len(children), np.float32), np.empty((len(children), tree.harmonics_count, 3), np.float32)
        for begin in range(0, len(children), 8 * PARENTS_PER_PIECE):
            part = slice(begin, begin + 8 * PARENTS_PER_PIECE)
            density[part], sh[part] = _interpolated(grid, children[part])
    x, y, z = grid.shape
    return tree_from_voxels(
        (2 * x, 2 * y, 2 * z), grid.voxel / 2, grid.bounds_min, children, density, sh, brick=grid.brick, background=grid.background, metadata=grid.metadata,
        ndc=grid.ndc, lookup=grid.lookup, step_size=grid.step_size,
    )  # fmt: skip


def _interpolated(grid: NerfTree, children: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Density (n,) and harmonics (n, K, 3) of a grid of one cascade at the centres of children, whose coordinates are (n, 3)."""
    stored = voxels_around(grid, (children + 0.5) * (grid.voxel / 2) + grid.bounds_min)
    # A child's centre lies a quarter of a voxel from its parent's: towards the upper neighbour if its coordinate is odd.
    fraction = np.where(children & 1, np.float32(0.25), np.float32(0.75))
    weight = np.prod(np.where(_CORNERS, fraction[:, None], 1 - fraction[:, None]), axis=-1) * (stored >= 0)
    density, sh = np.zeros(len(children), np.float32), np.zeros((len(children), grid.harmonics_count, 3), np.float32)
    for corner in range(8):
        density += weight[:, corner] * grid.density_values[stored[:, corner]]
        sh += weight[:, corner, None, None] * grid.sh[stored[:, corner]]
    return density, sh / weight.sum(axis=1)[:, None, None]
