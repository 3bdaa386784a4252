"""Trees made smaller."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from efficientnerf.asset.cascades import cascades_of, check_cascades, voxel_coordinates, voxels_at
from efficientnerf.asset.conversion import pruned, with_degree, with_resolution
from efficientnerf.asset.quantisation import compacted
from efficientnerf.asset.rendering import render_rays
from efficientnerf.asset.tree import NerfTree, Region, tree_from_voxels
from tests.efficientnerf.tree_reference import render_reference
from tests.efficientnerf.trees import random_cascades, random_tree, rays_at, tensors, uniform_tree


def same_pictures(a: NerfTree, b: NerfTree, tolerance: float = 1e-5) -> None:
    origins, directions = rays_at(a, 200)
    for name in ("colour", "opacity"):
        np.testing.assert_allclose(getattr(render_rays(a, origins, directions), name), getattr(render_rays(b, origins, directions), name), atol=tolerance)


@pytest.mark.parametrize("brick", [1, 3, 4])
def test_coordinates_and_their_voxels(brick: int) -> None:
    tree = random_tree(brick, brick=brick)
    at = voxel_coordinates(tree)
    assert np.array_equal(voxels_at(tree, cascades_of(tree)[0], at), np.arange(len(tree.density_values)))
    there = {tuple(row) for row in at.tolist()}
    every = np.argwhere(np.ones(np.array(tree.resolution) + 2, bool)) - 1
    for place, voxel in zip(every.tolist(), voxels_at(tree, cascades_of(tree)[0], every), strict=True):
        assert (voxel >= 0) == (tuple(place) in there)
        assert voxel < 0 or at[voxel].tolist() == place


def test_fewer_harmonics_are_the_first_ones() -> None:
    tree = random_tree(1, degree=3)
    assert np.array_equal(with_degree(tree, 1).sh, tree.sh[:, :4])
    with pytest.raises(ValueError, match="degree 4"):
        with_degree(tree, 4)


def test_a_thin_wall_lets_as_much_light_through() -> None:
    """Every second column of an opaque sheet missing: half of the light passes, which no average of densities would tell."""
    at = np.argwhere(np.ones((8, 8, 8), bool))
    kept = at[(at[:, 0] == 3) & (at[:, 1] % 2 == 0)]
    tree = tree_from_voxels((2, 2, 2), 0.1, np.zeros(3), kept, np.full(len(kept), 1e4, np.float32), np.ones((len(kept), 1, 3)))
    fewer = with_resolution(tree, 4)
    assert len(fewer.density_values) == 16
    along_x = np.exp(-fewer.density_values * 0.2)
    # Half is let through along x, half along y (the sheet is one of two layers), and half along z: so is the mean of them.
    np.testing.assert_allclose(along_x, (0.5 + 0.5 + 0.75) / 3, rtol=1e-4)


def test_pruning_changes_no_picture() -> None:
    tree = random_tree(4, shape=(5, 4, 6), share=0.6)
    values = np.where(np.random.default_rng(0).random(len(tree.density_values)) < 0.9, 0, tree.density_values).astype(np.float32)
    tree = replace(tree, density_values=values)
    fewer = pruned(tree)
    assert 0 < len(fewer.density_values) < len(tree.density_values)
    assert fewer.metadata == tree.metadata
    same_pictures(tree, fewer)
    coded = compacted(tree, 16)
    same_pictures(coded, pruned(coded))
    full = uniform_tree()
    assert pruned(full) is full


# Whole scenes.


def whole(seed: int = 5, **more: Any) -> NerfTree:
    tree = random_cascades(seed, brick=4, degree=1, share=0.5, **more)
    bounds = np.stack([tree.bounds_min, tree.bounds_max])
    return replace(tree, region=Region(bounds, 0.1, 0.0, np.random.default_rng(seed).random(len(tree.voxel_index)) < 0.5))


def reference_images(tree: NerfTree, like: NerfTree) -> tuple[np.ndarray, np.ndarray]:
    colour, opacity = render_reference(tree, *tensors(*rays_at(like, 60)))
    return colour.numpy(), opacity.numpy()


def test_cascades_get_larger_voxels_in_smaller_bricks_and_keep_their_boxes() -> None:
    tree = whole()
    for divisor in (1, 2, 4):
        fewer = with_resolution(tree, 16 // divisor)
        check_cascades(fewer)
        assert (fewer.brick, fewer.voxel) == (4 // divisor, pytest.approx(tree.voxel * divisor))
        for old, new in zip(cascades_of(tree), cascades_of(fewer), strict=True):
            assert old.shape == new.shape
            np.testing.assert_allclose(old.bounds(tree.brick), new.bounds(fewer.brick))
            assert np.array_equal(old.brick_index >= 0, new.brick_index >= 0)
        assert np.array_equal(fewer.region.bricks, tree.region.bricks)  # type: ignore[arg-type]
        assert np.array_equal(fewer.environment, tree.environment)  # type: ignore[arg-type]
    for found, wanted in zip(reference_images(with_resolution(tree, 16), tree), reference_images(tree, tree), strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-5)
