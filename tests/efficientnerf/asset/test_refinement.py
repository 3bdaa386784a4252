"""Fitting a tree to images: gradients against autograd and finite differences, steps against their formula, and what it is for."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from efficientnerf.asset.cascades import subset, voxel_coordinates
from efficientnerf.asset.queries import density_at
from efficientnerf.asset.refinement.fit import error, max_weights, optimise
from efficientnerf.asset.refinement.host import in_voxels
from efficientnerf.asset.refinement.state import initial_state
from efficientnerf.asset.refinement.targets import Targets
from efficientnerf.asset.rendering import render_rays
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.layout import EARLY_STOP
from efficientnerf.backends.numba.tree.cells import cells_of, dense_densities, voxel_places
from efficientnerf.backends.numba.tree_training import gradients as kernels
from efficientnerf.backends.numba.tree_training.gradients import RecordBuffer, packets_of
from efficientnerf.training.pixels import Pixels
from tests.efficientnerf.balls import BOUNDS, cameras, picture, pixels
from tests.efficientnerf.refinements import ball_tree, gradients, seen_at_random, sum_gradients
from tests.efficientnerf.trees import random_tree, rays_at, uniform_tree


def test_float32_and_the_early_stop_change_little() -> None:
    tree = random_tree(3, brick=4, degree=2)
    rays = rays_at(tree, 500)
    exact = gradients(tree, *rays, seen_at_random(500, 0.3))
    usual = gradients(tree, *rays, seen_at_random(500, 0.3, np.float32), np.float32, EARLY_STOP)
    for a, b in zip(exact, usual, strict=True):
        np.testing.assert_allclose(a, b, atol=2e-3 * np.abs(a).max())


def test_records_grow_until_all_samples_fit() -> None:
    tree = uniform_tree((12, 12, 12), brick=2, sigma=0.05)
    origins, directions = rays_at(tree, 300)
    buffer = RecordBuffer()
    buffer.capacity = 7
    start, along, bases = in_voxels(tree, origins, directions)
    o = initial_state(tree)
    seen = seen_at_random(300, 0.0, np.float32)
    cells = cells_of(tree)
    dense = dense_densities(cells, voxel_places(cells, len(o.sh)), o.density)
    _, records = kernels.forward_backward(cells, packets_of(300), start, along, bases, dense, o.sh, seen, buffer)
    assert 7 < (records.begin[:, -1] - records.begin[:, 0]).max() <= buffer.capacity
    by_density, by_sh = np.zeros_like(o.density), np.zeros_like(o.sh)
    sum_gradients(records, by_density, by_sh)
    expected = gradients(tree, origins, directions, seen, np.float32, EARLY_STOP)
    np.testing.assert_array_equal(by_density, expected[1])


def fitted(tree: NerfTree, targets: Targets, steps: int, **more: Any) -> tuple[NerfTree, list[float]]:
    o = initial_state(tree)
    rates = {"until": steps, "rays": 512, "density_lr": 0.3, "sh_lr": 0.05, "fall": lambda step: 0.1 ** (step / steps), "seed": 1, **more}
    errors = list(optimise(o, targets, **rates))
    return o.result(), errors


def test_fog_becomes_the_ball_of_the_pictures() -> None:
    targets = Targets(pixels(10, 24), (1.0, 1.0, 1.0))
    tree, errors = fitted(ball_tree(), targets, 80, patch_side=1)
    assert error(tree, targets, 2000, 0) < 0.05 * error(ball_tree(), targets, 2000, 0)
    assert len(errors) == 80
    assert density_at(tree, np.array([[0.6, -0.05, 0.0]]))[0] > 5
    assert density_at(tree, np.array([[0.85, 0.8, 0.8]]))[0] < 0.3
    assert (tree.density_values >= 0).all()


@pytest.mark.parametrize("share", [None, 0.5, 0.003])
def test_the_error_is_that_of_all_usable_pixels(share: float | None) -> None:
    """Estimated from patches, some of which have few usable pixels or none."""
    rng, seen_by = np.random.default_rng(0), cameras(6, 32)
    masks = [None if share is None else rng.random((32, 32)) < share for _ in seen_by]
    some = Pixels(seen_by, [picture(each) for each in seen_by], masks, np.full(6, 1.0), np.full(6, 5.0))
    tree, targets = ball_tree(), Targets(some, (1.0, 1.0, 1.0))
    usable = some.usable_pixels(np.arange(some.usable_count))
    origins, directions, seen = targets.of(usable, constant_background=True)
    exact = gradients(tree, origins, directions, seen, np.float32)[0].sum() / (3 * len(usable))
    assert error(tree, targets, 20 * len(some), 0) == pytest.approx(exact, rel=0.05)


def test_photographs_are_compared_over_the_environment() -> None:
    """The right environment leaves nothing for the tree to do; so that what stands before it in another colour fades."""
    some = pixels(4, 12)
    some.images = np.full((len(some), 3), 51, np.uint8)
    grey = np.full((4, 8, 3), 0.2, np.float32)
    tree = ball_tree()
    assert error(replace(tree, density_values=0 * tree.density_values), Targets(some, None, grey), 100, 0) < 1e-6
    assert error(tree, Targets(some, None, grey), 100, 0) > 1e-3
    cleared, _ = fitted(replace(tree, harmonics=tree.harmonics + 3), Targets(some, None, grey), 40)
    assert np.median(cleared.density_values) < 0.3 * tree.density_values[0]  # no ray sees the corners
    with pytest.raises(ValueError, match="environment"):
        Targets(some, None)


@pytest.mark.parametrize("alpha", [True, False])
def test_objects_and_boxes_to_infinity_are_compared_over_the_mean_of_random_backgrounds(alpha: bool) -> None:
    """Pictures without alpha: what reaches to infinity should be opaque."""
    some, tree, index = pixels(6, 16), ball_tree(), np.arange(600, 700)
    if not alpha:
        some.images = np.ascontiguousarray(some.images[:, :3])
    ground = 1.0 if alpha else 0.5
    targets = Targets(some, (ground,) * 3, reaches_infinity=not alpha)
    origins, directions, seen = targets.of(index)
    loss = gradients(tree, origins, directions, seen, np.float32)[0]
    seen_as = render_rays(tree, origins, directions)
    picture_of, behind = some.images[index] / 255, np.random.default_rng(0).random((20000, 1, 3))
    share = picture_of[:, 3:] if alpha else 1.0
    truth = picture_of[:, :3] * share + behind * (1 - share)
    drawn = ((seen_as.colour + behind * (1 - seen_as.opacity[:, None]) - truth) ** 2).sum(axis=2).mean(axis=0)
    np.testing.assert_allclose(loss, drawn, atol=0.02)
    constant = targets.of(index, constant_background=True)[2]
    assert constant.opacity_weight == 0
    np.testing.assert_array_equal(constant.background, ground)


def test_weights_are_what_voxels_contribute() -> None:
    """One voxel before another: the greatest weight of each, through what interpolation leaves it, against sums by hand."""
    tree = uniform_tree((2, 2, 2), brick=4, voxel=0.25, sigma=4.0)
    tree = replace(tree, bounds_min=BOUNDS[0], background=(1.0, 1.0, 1.0))
    looked: list[tuple[int, int]] = []
    weights = max_weights(tree, Targets(pixels(8, 24), (1.0, 1.0, 1.0)), 4000, 0, lambda *done: looked.append(done))
    assert looked == [(4000, 4000)]
    at = voxel_coordinates(tree)
    skin = ((at == 0) | (at == 7)).any(axis=1)
    assert weights.min() > 0
    assert weights.max() <= 1 - np.exp(-4 * 0.125) + 1e-6  # of a single sample
    assert weights[skin].mean() > 2 * weights[~skin].mean()
    without = subset(tree, weights > np.median(weights))
    assert len(without.density_values) == (weights > np.median(weights)).sum()
    np.testing.assert_array_equal(voxel_coordinates(without), at[weights > np.median(weights)])
