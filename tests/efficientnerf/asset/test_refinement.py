"""Fitting a tree to images: gradients against autograd and finite differences, steps against their formula, and what it is for."""

from dataclasses import replace
from typing import Any

import numba
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
from efficientnerf.backends.numba.tree.contributions import max_contributions
from efficientnerf.backends.numba.tree_training import gradients as kernels
from efficientnerf.backends.numba.tree_training.gradients import RecordBuffer, packets_of
from efficientnerf.training.pixels import Pixels
from tests.efficientnerf.balls import BOUNDS, cameras, picture, pixels
from tests.efficientnerf.refinements import ball_tree, gradients, gradients_by_autograd, seen_at_random, sum_gradients
from tests.efficientnerf.trees import random_tree, rays_at, uniform_tree


@pytest.mark.parametrize(("brick", "degree", "opacity_weight"), [(1, 0, 0.0), (3, 1, 0.7), (4, 2, 0.0), (2, 3, 0.7)])
def test_values_and_gradients_are_those_of_autograd(brick: int, degree: int, opacity_weight: float) -> None:
    tree = random_tree(brick, brick=brick, degree=degree)
    origins, directions = rays_at(tree, 300)
    seen = seen_at_random(300, opacity_weight)
    loss, by_density, by_sh = gradients(tree, origins, directions, seen)
    wanted, wanted_by_density, wanted_by_sh = gradients_by_autograd(tree, origins, directions, seen)
    np.testing.assert_allclose(loss, wanted, atol=2e-6)  # the kernel's harmonics are of float32 directions
    np.testing.assert_allclose(by_density, wanted_by_density, atol=2e-5 * np.abs(wanted_by_density).max())
    np.testing.assert_allclose(by_sh, wanted_by_sh, atol=2e-5 * np.abs(wanted_by_sh).max())
    assert (by_density != 0).mean() > 0.5


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


def test_any_background_is_the_mean_over_random_ones() -> None:
    some = pixels(6, 16)
    tree = ball_tree()
    targets = Targets(some, (1.0, 1.0, 1.0))
    index = np.arange(600, 700)
    origins, directions, seen = targets.of(index)
    loss = gradients(tree, origins, directions, seen, np.float32)[0]
    rng = np.random.default_rng(0)
    seen_as = render_rays(tree, origins, directions)
    rgba = some.images[index] / 255
    behind = rng.random((20000, 1, 3))
    truth = rgba[:, :3] * rgba[:, 3:] + behind * (1 - rgba[:, 3:])
    drawn = ((seen_as.colour + behind * (1 - seen_as.opacity[:, None]) - truth) ** 2).sum(axis=2).mean(axis=0)
    np.testing.assert_allclose(loss, drawn, atol=0.02)
    white = targets.of(index, constant_background=True)[2]
    assert white.opacity_weight == 0
    np.testing.assert_array_equal(white.background, 1)


def test_what_reaches_to_infinity_should_be_opaque_before_any_background() -> None:
    some = pixels(6, 16)
    some.images = np.ascontiguousarray(some.images[:, :3])
    tree = ball_tree()
    targets = Targets(some, (0.5, 0.5, 0.5), reaches_infinity=True)
    index = np.arange(600, 700)
    origins, directions, seen = targets.of(index)
    loss = gradients(tree, origins, directions, seen, np.float32)[0]
    seen_as = render_rays(tree, origins, directions)
    behind = np.random.default_rng(0).random((20000, 1, 3))
    drawn = ((seen_as.colour + behind * (1 - seen_as.opacity[:, None]) - some.images[index] / 255) ** 2).sum(axis=2).mean(axis=0)
    np.testing.assert_allclose(loss, drawn, atol=0.02)
    declared = targets.of(index, constant_background=True)[2]
    assert declared.opacity_weight == 0
    np.testing.assert_array_equal(declared.background, 0.5)


def test_the_same_bytes_interrupted_or_not_on_one_thread_or_two() -> None:
    targets = Targets(pixels(6, 16), (1.0, 1.0, 1.0))
    whole, _ = fitted(ball_tree(), targets, 12)
    again = initial_state(ball_tree())
    rates: dict[str, Any] = {"rays": 512, "density_lr": 0.3, "sh_lr": 0.05, "fall": lambda step: 0.1 ** (step / 12), "seed": 1}
    list(optimise(again, targets, until=5, **rates))
    threads = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        list(optimise(again, targets, until=12, **rates))
    finally:
        numba.set_num_threads(threads)
    np.testing.assert_array_equal(again.result().density_values, whole.density_values)
    np.testing.assert_array_equal(again.result().sh, whole.sh)
    other, _ = fitted(ball_tree(), targets, 12, seed=2)
    assert not np.array_equal(other.sh, whole.sh)


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


def weights_by_hand(tree: NerfTree, origins: np.ndarray, directions: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """Samples of FORMAT.md, section 6, one after the other."""
    out, number = np.zeros(len(tree.density_values)), {tuple(at): n for n, at in enumerate(voxel_coordinates(tree).tolist())}
    size = np.array(tree.resolution)
    for ray, (origin, along) in enumerate(zip((origins - tree.bounds_min) / tree.voxel, directions, strict=True)):
        with np.errstate(divide="ignore"):
            faces = np.stack([-origin / along, (size - origin) / along])
        begin, end, light = max(faces.min(axis=0).max(), 0.0), faces.max(axis=0).min(), 1.0
        for t in np.arange(begin + 0.25, end, 0.5):
            point = origin + t * along
            sigma = float(density_at(tree, (tree.bounds_min + point * tree.voxel)[None])[0])
            alpha = 1 - np.exp(-sigma * 0.5 * tree.voxel)
            low = np.floor(point - 0.5).astype(int)
            for corner in np.ndindex(2, 2, 2):
                v = number.get(tuple((low + corner).tolist()), -1)
                share = np.prod(np.where(corner, point - 0.5 - low, 1.5 - point + low))
                if v >= 0:
                    out[v] = max(out[v], gain[ray] * light * alpha * share)
            light *= 1 - alpha
    return out


def test_greatest_weights_are_those_of_a_march_by_hand() -> None:
    tree = random_tree(3, shape=(2, 3, 2), brick=3, sigma=6.0)
    origins, directions = rays_at(tree, 40)
    gain = np.random.default_rng(0).random(40).astype(np.float32)
    start, along, _ = in_voxels(tree, origins, directions)
    found = []
    for parts in (1, 3):
        into = np.zeros((parts, len(tree.density_values)), np.float32)
        for half in (slice(0, 25), slice(25, 40)):  # what is known is raised
            max_contributions(cells_of(tree), start[half], along[half], tree.density_values, gain[half], into, stop=0.0)
        found.append(into.max(axis=0))
    np.testing.assert_array_equal(*found)
    np.testing.assert_allclose(found[0], weights_by_hand(tree, origins, directions, gain), atol=1e-5)
    assert (found[0] > 0).mean() > 0.3
