"""The tree in memory: how it is built and asked, loop against kernel."""

import numpy as np
import pytest

from efficientnerf.asset.queries import colour_at, density_at, density_block, normal_at
from efficientnerf.asset.rendering import render_rays
from efficientnerf.asset.tree import NerfTree, tree_from_voxels
from tests import reference
from tests.efficientnerf.trees import LOW, TREES, random_tree


def queried(tree: NerfTree, count: int = 150) -> np.ndarray:
    """Points in the tree and a little beyond it, world."""
    margin = 2 * tree.voxel
    return np.random.default_rng(1).uniform(tree.bounds_min - margin, tree.bounds_max + margin, (count, 3))


def in_voxels(tree: NerfTree, points: np.ndarray) -> np.ndarray:
    return ((points - tree.bounds_min) / tree.voxel).astype(np.float32).astype(np.float64)


@pytest.mark.parametrize(("brick", "degree"), TREES)
def test_densities_are_those_of_the_loop(brick: int, degree: int) -> None:
    tree = random_tree(brick, brick=brick, degree=degree)
    points = queried(tree)
    expected = np.array([reference.tree_density(tree, p) for p in in_voxels(tree, points)])
    np.testing.assert_allclose(density_at(tree, points), expected, atol=1e-3)
    assert (expected > 0).any()


@pytest.mark.parametrize(("brick", "degree"), TREES)
def test_colours_are_those_of_the_loop(brick: int, degree: int) -> None:
    tree = random_tree(brick, brick=brick, degree=degree)
    points = queried(tree)
    directions = np.random.default_rng(2).normal(size=points.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    expected = [reference.tree_colour(tree, p, reference.harmonics(d, degree)) for p, d in zip(in_voxels(tree, points), directions, strict=True)]
    np.testing.assert_allclose(colour_at(tree, points, directions), expected, atol=1e-4)
    plain = [reference.tree_colour(tree, p, [0.28209479177387814]) for p in in_voxels(tree, points)]
    np.testing.assert_allclose(colour_at(tree, points), plain, atol=1e-4)


def test_normals_point_down_the_density() -> None:
    tree = random_tree(3)
    points = queried(tree)
    for p, normal in zip(in_voxels(tree, points), normal_at(tree, points), strict=True):
        around = [(p + step, p - step) for step in np.eye(3)]
        gradient = np.array([reference.tree_density(tree, a) - reference.tree_density(tree, b) for a, b in around])
        length = np.linalg.norm(gradient)
        np.testing.assert_allclose(normal, -gradient / length if length > 0 else 0 * gradient, atol=1e-3)


def test_a_point_in_an_empty_cell_has_no_density() -> None:
    indices = np.argwhere(np.ones((4, 4, 4), bool))
    tree = tree_from_voxels((2, 1, 1), 1.0, np.zeros(3), indices, np.full(64, 8.0, np.float32), np.zeros((64, 1, 3), np.float32))
    points = np.array([[3.99, 2.0, 2.0], [4.01, 2.0, 2.0], [3.5, 2.0, 2.0], [0.01, 2.0, 2.0], [-0.01, 2.0, 2.0]])
    np.testing.assert_allclose(density_at(tree, points), [8 * 0.51, 0, 8, 8 * 0.51, 0], rtol=1e-4)


@pytest.mark.parametrize(("brick", "degree"), TREES)
def test_blocks_hold_the_stored_values(brick: int, degree: int) -> None:
    tree = random_tree(brick, brick=brick, degree=degree)
    low, high = (-2, -1, 0), tuple(n + 2 for n in tree.resolution)
    block = density_block(tree, low, high)  # type: ignore[arg-type]
    expected = np.zeros(block.shape, np.float32)
    for i, j, k in np.ndindex(*tree.resolution):
        owner = tree.brick_index[i // brick, j // brick, k // brick]
        stored = tree.voxel_index[owner, ((i % brick) * brick + j % brick) * brick + k % brick] if owner >= 0 else -1
        if stored >= 0:
            expected[i + 2, j + 1, k] = tree.density_values[stored]
    assert np.array_equal(block, expected)
    centres = tree.bounds_min + (np.argwhere(expected[2:-2, 1:-2, :-2] > 0) + 0.5) * tree.voxel
    np.testing.assert_allclose(np.sort(density_at(tree, centres)), np.sort(expected[expected > 0]), rtol=1e-3, atol=1e-3)


def test_lists_that_make_no_tree_are_refused() -> None:
    density, sh = np.ones(2, np.float32), np.zeros((2, 1, 3), np.float32)
    with pytest.raises(ValueError, match="listed twice"):
        tree_from_voxels((1, 1, 1), 0.1, LOW, np.array([[1, 2, 3], [1, 2, 3]]), density, sh)
    for outside in ([0, 0, 4], [-1, 0, 0]):
        with pytest.raises(ValueError, match="outside of the grid"):
            tree_from_voxels((1, 1, 1), 0.1, LOW, np.array([[1, 2, 3], outside]), density, sh)
    with pytest.raises(ValueError, match="expected 0 to 4"):
        tree_from_voxels((1, 1, 1), 0.1, LOW, np.array([[1, 2, 3], [0, 0, 0]]), density, np.zeros((2, 36, 3), np.float32))


def test_leaps_end_before_the_nearest_brick() -> None:
    tree = random_tree(2, shape=(6, 5, 7), brick=2, share=0.04)
    occupied = np.argwhere(tree.brick_index >= 0)
    for cell in np.ndindex(*tree.shape):
        assert tree.leap[cell] == np.abs(occupied - cell).max(1).min()


def test_an_empty_tree_can_be_asked_anything() -> None:
    tree = tree_from_voxels((2, 3, 1), 0.1, LOW, np.zeros((0, 3), int), np.zeros(0), np.zeros((0, 4, 3)))
    points = queried(tree, 10)
    assert not density_at(tree, points).any()
    assert (colour_at(tree, points) == 0.5).all()
    assert not density_block(tree, (0, 0, 0), (8, 12, 4)).any()
    assert not render_rays(tree, LOW[None] - 1, np.full((1, 3), 3**-0.5)).opacity.any()
