"""Splitting of voxels: `efficientnerf.asset.refinement.splitting`."""

from __future__ import annotations

import numpy as np
import pytest

from efficientnerf.asset.cascades import cascade_sides, cascades_of, voxel_cascades, voxel_coordinates
from efficientnerf.asset.queries import colour_at, density_at
from efficientnerf.asset.refinement.splitting import split, split_tree
from efficientnerf.asset.refinement.state import initial_state
from efficientnerf.asset.rendering import render_rays
from efficientnerf.asset.tree import NerfTree
from tests.efficientnerf.trees import random_cascades, random_tree, rays_at, uniform_tree


def centres(tree: NerfTree) -> np.ndarray:
    """(N, 3) of the voxels, in the frame."""
    low = np.stack([cascade.bounds_min for cascade in cascades_of(tree)])
    of = voxel_cascades(tree)
    return (voxel_coordinates(tree) + 0.5) * cascade_sides(tree)[of][:, None] + low[of]


@pytest.mark.parametrize("tree", [random_tree(3), random_tree(4, brick=4, degree=2), random_cascades(2)], ids=["one", "degree2", "nested"])
def test_children_hold_what_the_tree_has_at_their_centres(tree: NerfTree) -> None:
    fine = split_tree(tree, np.ones(len(tree.density_values), bool))

    assert len(fine.density_values) == 8 * len(tree.density_values)
    assert fine.resolution == tuple(2 * n for n in tree.resolution)
    assert np.allclose(fine.bounds_max, tree.bounds_max)
    at = centres(fine)
    inner = np.ones(len(at), bool)
    if tree.outer:  # near the box that is cut out of a cascade, points belong to the one before
        low, high = tree.bounds_min, tree.bounds_max
        inner = ((at > low) & (at < high)).all(axis=1) & (voxel_cascades(fine) == 0)
    np.testing.assert_allclose(fine.density_values[inner], density_at(tree, at[inner]), rtol=1e-4, atol=1e-5)
    direction = np.tile([[0.6, 0.0, 0.8]], (int(inner.sum()), 1))
    np.testing.assert_allclose(colour_at(fine, at[inner], direction), colour_at(tree, at[inner], direction), atol=0.35)  # the finer one interpolates again


def test_voxels_that_are_not_chosen_have_no_children() -> None:
    tree = random_tree(5)
    keep = np.arange(len(tree.density_values)) % 3 == 0
    fine = split_tree(tree, keep)

    parents = {tuple(p) for p in voxel_coordinates(tree)[keep]}
    assert {tuple(p) for p in voxel_coordinates(fine) // 2} == parents
    assert len(fine.density_values) == 8 * keep.sum()


def test_renders_of_a_uniform_tree_stay() -> None:
    tree = uniform_tree()
    fine = split_tree(tree, np.ones(len(tree.density_values), bool))

    rays = rays_at(tree, 200)
    before, after = render_rays(tree, *rays), render_rays(fine, *rays)
    assert np.abs(before.opacity - after.opacity).mean() < 0.02
    hit = (before.opacity > 0.5) & (after.opacity > 0.5)
    assert hit.sum() > 20
    np.testing.assert_allclose(after.colour[hit] / after.opacity[hit, None], before.colour[hit] / before.opacity[hit, None], atol=1e-3)


def test_the_state_begins_anew_and_keeps_its_step() -> None:
    tree = random_tree(7)
    state = initial_state(tree)
    state.step = 12
    state.visits[:] = 5
    found = split(state, np.ones(len(tree.density_values), bool))

    assert found.step == 12
    assert not found.visits.any()
    assert not found.square_density.any()
    assert not found.square_sh.any()
    assert found.tree.voxel == tree.voxel / 2
