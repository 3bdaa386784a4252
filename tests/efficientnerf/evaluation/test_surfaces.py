"""Where density lies against surfaces: closed forms in uniform trees, the reference render, cascades and normalised device coordinates."""

import numpy as np
import pytest
import torch

from efficientnerf.evaluation.surfaces import MARGIN_VOXELS, opacity_nearer, surface_limits
from tests.efficientnerf.tree_reference import render_reference
from tests.efficientnerf.trees import random_cascades, random_tree, rays_at, uniform_tree
from tests.efficientnerf.walls import DEPTH, NEAR, looking_along_y, wall


def test_the_opacity_up_to_a_limit_in_a_uniform_box_is_the_closed_form() -> None:
    tree = uniform_tree(sigma=2.0)
    centre = (tree.bounds_min + tree.bounds_max) / 2
    directions = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, 1]])
    half = (tree.bounds_max - tree.bounds_min)[0] / 2
    limits = np.array([0.7, 0.2, 0.45])
    found = opacity_nearer(tree, np.tile(centre, (3, 1)), directions, limits)
    np.testing.assert_allclose(found, 1 - np.exp(-2.0 * limits), atol=0.02)  # trilinear: half a voxel at the border is less dense
    beyond = opacity_nearer(tree, np.tile(centre, (3, 1)), directions, np.full(3, np.inf))
    np.testing.assert_allclose(beyond, 1 - np.exp(-2.0 * half), atol=0.04)
    assert (opacity_nearer(tree, np.tile(centre, (3, 1)), directions, np.zeros(3)) == 0).all()
    assert (opacity_nearer(tree, np.tile(centre + 100, (3, 1)), directions, np.full(3, np.inf)) == 0).all()


@pytest.mark.parametrize("make", [random_cascades, random_tree], ids=["cascades", "one box"])
def test_without_a_limit_it_is_the_opacity_of_the_reference(make) -> None:  # type: ignore[no-untyped-def]
    tree = make(4)
    origins, directions = rays_at(tree, 80)
    wanted = render_reference(tree, torch.from_numpy(origins), torch.from_numpy(directions))[1].numpy()
    found = opacity_nearer(tree, origins, directions, np.full(80, np.inf))
    assert np.abs(found - wanted).mean() < 0.03, "steps of a voxel in place of half of one"
    assert np.corrcoef(found, wanted)[0, 1] > 0.99


def test_in_normalised_device_coordinates_limits_are_of_the_world() -> None:
    tree = wall()
    eye = looking_along_y()
    origins, directions = eye[:3, 3][None], eye[:3, 2][None]
    nearer = [opacity_nearer(tree, origins, directions, np.array([limit]))[0] for limit in (DEPTH - 0.3, DEPTH + 1.5, np.inf)]
    assert nearer[0] == 0
    assert nearer[1] > 0.99
    assert nearer[2] >= nearer[1]
    limit = surface_limits(tree, origins, directions, np.array([DEPTH]))
    # z' = 1 - 2 n / z: so many voxels of z' before the wall
    np.testing.assert_allclose(limit, 2 * NEAR / (2 * NEAR / DEPTH + MARGIN_VOXELS * tree.voxel))
