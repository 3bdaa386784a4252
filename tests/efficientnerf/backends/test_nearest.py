"""Nearest lookup: the values of the voxel that holds a point, in the kernels, in files and in the fit; torch against the loop is in `test_render`."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from efficientnerf.asset.cascades import cascades_of, voxels_at
from efficientnerf.asset.conversion import pruned, with_degree, with_resolution
from efficientnerf.asset.format import describe, load, save
from efficientnerf.asset.queries import colour_at, density_at
from efficientnerf.asset.refinement.state import initial_state
from efficientnerf.asset.rendering import render, render_rays
from efficientnerf.asset.tree import NerfTree
from efficientnerf.geometry.cameras import rays
from efficientnerf.rendering.harmonics import basis_numpy
from tests import reference
from tests.efficientnerf.nerftree_reader import Tree
from tests.efficientnerf.tree_reference import render_reference
from tests.efficientnerf.trees import TREES, random_tree, rays_at, tensors, uniform_tree
from tests.efficientnerf.walls import camera_at, wall


def nearest(brick: int, degree: int = 1, **more: object) -> NerfTree:
    return random_tree(brick, brick=brick, degree=degree, lookup="nearest", **more)  # type: ignore[arg-type]


@pytest.mark.parametrize(("brick", "degree"), TREES[1:4])
def test_points_get_the_values_of_their_voxel(brick: int, degree: int) -> None:
    tree = nearest(brick, degree)
    rng = np.random.default_rng(0)
    points = rng.uniform(tree.bounds_min - 0.1, tree.bounds_max + 0.1, (800, 3))
    directions = rays_at(tree, 800)[1]
    voxel = voxels_at(tree, cascades_of(tree)[0], np.floor((points - tree.bounds_min) / tree.voxel).astype(np.int64))
    stored = voxel >= 0
    assert 0.02 < stored.mean() < 0.6
    assert np.array_equal(density_at(tree, points), np.where(stored, tree.density_values[voxel], 0))
    logit = np.einsum("nk,nkc->nc", basis_numpy(directions.astype(np.float32), degree), tree.sh[voxel])
    np.testing.assert_allclose(colour_at(tree, points, directions), np.where(stored[:, None], 1 / (1 + np.exp(-logit)), 0.5), atol=1e-5)
    other = replace(tree, lookup="trilinear")
    assert np.abs(density_at(tree, points) - density_at(other, points)).max() > 1


@pytest.mark.parametrize(("brick", "degree"), TREES[1:4])
def test_the_kernel_matches_the_torch_reference(brick: int, degree: int) -> None:
    tree = nearest(brick, degree)
    origins, directions = rays_at(tree, 400)
    colour, opacity = render_reference(tree, *tensors(origins, directions))
    outputs = render_rays(tree, origins, directions)
    np.testing.assert_allclose(outputs.opacity, opacity, atol=1e-3)
    np.testing.assert_allclose(outputs.colour, colour, atol=1e-3)
    assert 0.2 < (outputs.opacity > 0.05).mean() < 0.9
    other = render_rays(replace(tree, lookup="trilinear"), origins, directions)
    assert np.abs(other.colour - outputs.colour).max() > 0.05


def test_a_uniform_box_has_its_closed_form_to_its_very_face() -> None:
    tree = replace(uniform_tree(sigma=2.0), lookup="nearest")
    middle = (tree.bounds_min + tree.bounds_max) / 2
    outputs = render_rays(tree, (middle - [4, 0, 0])[None], np.array([[1.0, 0, 0]]))
    width = float(tree.bounds_max[0] - tree.bounds_min[0])
    assert float(outputs.opacity[0]) == pytest.approx(1 - math.exp(-2 * width), abs=1e-3)
    assert float(outputs.depth[0]) == pytest.approx(4 - width / 2 + math.log(2) / 2, abs=1e-4)
    np.testing.assert_allclose(outputs.colour[0], outputs.opacity[0] * reference.sigmoid(0.7), atol=1e-3)


def test_in_normalised_device_coordinates_too() -> None:
    tree = replace(wall(), lookup="nearest")
    camera = camera_at(0, 0, 0)
    outputs, other = render(tree, camera), render(wall(), camera)
    np.testing.assert_allclose(outputs.opacity, other.opacity, atol=0.01)
    assert not np.array_equal(outputs.colour, other.colour)
    colour, opacity = render_reference(tree, *tensors(*rays(camera)))
    np.testing.assert_allclose(outputs.colour.reshape(-1, 3), colour, atol=1e-3)
    np.testing.assert_allclose(outputs.opacity.reshape(-1), opacity, atol=1e-3)


@pytest.mark.parametrize(("layout", "name"), [(None, "nearest-sparse"), ("full32", "nearest-full")])
def test_a_file_keeps_the_lookup_and_the_short_reader_sees_the_same(tmp_path: Path, layout: str | None, name: str) -> None:
    path = tmp_path / "a.nerftree"
    save(nearest(3, share=0.6), path, layout)
    about, ours, theirs = describe(path), load(path), Tree(path)
    assert (about["layout"], about["format_version"], about["lookup"]) == (name, "1.3", "nearest")
    assert ours.lookup == "nearest"
    assert "lookup" not in ours.metadata
    points = np.random.default_rng(0).uniform(ours.bounds_min - 0.1, ours.bounds_max + 0.1, (100, 3))
    origins, directions = rays_at(ours, 100)
    np.testing.assert_allclose(density_at(ours, points), [theirs.density(p) for p in points], atol=2e-3)
    np.testing.assert_allclose(colour_at(ours, points, directions), [theirs.colour(p, d) for p, d in zip(points, directions, strict=True)], atol=1e-3)
    outputs = render_rays(ours, origins[:12], directions[:12])
    for r in range(12):
        colour, opacity = theirs.ray(origins[r], directions[r])
        np.testing.assert_allclose(outputs.colour[r], colour, atol=1.5e-3)
        assert float(outputs.opacity[r]) == pytest.approx(opacity, abs=1.5e-3)


def test_derived_trees_keep_the_lookup() -> None:
    tree = nearest(4, 2)
    made = [with_degree(tree, 1), with_resolution(tree, 10), pruned(tree), initial_state(tree).result()]
    assert [each.lookup for each in made] == ["nearest"] * 4
