"""Which pieces of a tree are scraps."""

from dataclasses import replace

import numpy as np
import pytest

from efficientnerf.asset.cascades import cascade_grids, nested, voxel_cascades, voxel_coordinates
from efficientnerf.asset.components import foreground_bricks, small_components
from efficientnerf.asset.region import foreground
from efficientnerf.asset.tree import NerfTree, Region, tree_from_voxels

SHAPE = (12, 12, 12)


def tree_of(*boxes: tuple[tuple[int, int, int], tuple[int, int, int]], brick: int = 4) -> tuple[NerfTree, np.ndarray]:
    """A tree of boxes of voxels (low, high), and which box each stored voxel came from."""
    grid = np.full(np.array(SHAPE) * brick, -1)
    for number, (low, high) in enumerate(boxes):
        grid[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = number
    indices = np.argwhere(grid >= 0)
    tree = tree_from_voxels(SHAPE, 0.1, np.zeros(3), indices, np.ones(len(indices)), np.zeros((len(indices), 1, 3), np.float32), brick=brick)
    return tree, grid[tuple(voxel_coordinates(tree).T)]


def everything(tree: NerfTree) -> np.ndarray:
    return np.ones(len(tree.density_values), bool)


def test_a_small_piece_that_the_box_cuts_off_is_a_scrap() -> None:
    tree, of = tree_of(((8, 8, 8), (28, 28, 28)), ((40, 40, 44), (44, 44, 48)), ((36, 8, 36), (40, 12, 40)))  # 8000, 64 (at a face), 64 (inside) voxels
    np.testing.assert_array_equal(small_components(tree, everything(tree), 0.02), of == 1)


def test_large_pieces_at_a_face_and_what_touches_at_a_corner_stay() -> None:
    tree, _ = tree_of(((0, 0, 0), (16, 16, 16)), ((28, 28, 28), (48, 48, 48)), ((24, 24, 24), (28, 28, 28)))
    assert not small_components(tree, everything(tree), 0.1).any()


@pytest.mark.parametrize("brick", [1, 2, 4])
def test_the_largest_piece_is_never_a_scrap(brick: int) -> None:
    rng = np.random.default_rng(brick)
    indices = np.argwhere(rng.random(np.array(SHAPE) * brick) < 0.02 / brick)
    tree = tree_from_voxels(SHAPE, 0.1, np.zeros(3), indices, np.ones(len(indices)), np.zeros((len(indices), 1, 3), np.float32), brick=brick)
    assert not small_components(tree, everything(tree), 0).any()
    assert not small_components(tree, everything(tree), 1.0).all()


def test_small_parts_that_touch_nothing_are_no_foreground() -> None:
    tree, box = tree_of(((2, 2, 2), (32, 32, 32)), ((40, 40, 40), (43, 43, 43)), ((36, 4, 36), (44, 12, 44)))
    grids = cascade_grids(np.stack([tree.bounds_min, tree.bounds_max]), tree.voxel, tree.brick, 2)
    shape, voxel, low = grids[1]
    around = tree_from_voxels(shape, voxel, low, np.array([[0, 0, 0], [40, 40, 40]]), np.ones(2), np.zeros((2, 1, 3), np.float32), brick=tree.brick)
    whole = replace(nested([tree, around]), region=Region(np.stack([tree.bounds_min - 9, tree.bounds_max + 9])))
    bricks = foreground_bricks(whole)
    kept = foreground(replace(whole, region=replace(whole.region, bricks=bricks)))  # type: ignore[type-var]
    inner = voxel_coordinates(kept)[voxel_cascades(kept) == 0]
    assert {tuple(at) for at in inner} == {tuple(at) for at in voxel_coordinates(tree)[box != 1]}
    assert (voxel_cascades(kept) == 1).sum() == 2
    faint = replace(whole, density_values=np.full_like(whole.density_values, 1e-3))
    assert foreground_bricks(faint).all()
