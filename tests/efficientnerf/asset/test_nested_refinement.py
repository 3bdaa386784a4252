"""Refinement of nested trees on the CPU: rays through all cascades, their gradients, steps by each cascade's own voxels, and the same bytes whatever the
threads and interruptions."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from efficientnerf.asset.cascades import cascade_grids, cascades_of, nested, subset, voxel_cascades
from efficientnerf.asset.refinement.fit import error, max_weights, optimise
from efficientnerf.asset.refinement.host import in_voxels
from efficientnerf.asset.refinement.state import initial_state, subset_state
from efficientnerf.asset.refinement.targets import Targets
from efficientnerf.asset.rendering import ray_parts
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.numba.tree import contributions as kernels
from efficientnerf.backends.numba.tree.cells import cells_of
from efficientnerf.backends.numba.tree.nearest import render_rays as render_nearest
from efficientnerf.rendering import environment
from tests.efficientnerf.balls import pixels
from tests.efficientnerf.refinements import ball_tree, gradients, gradients_by_autograd, seen_at_random
from tests.efficientnerf.threads import on_threads
from tests.efficientnerf.tree_reference import render_reference, tree_density
from tests.efficientnerf.trees import nested_rays, random_cascades, tensors, uniform_tree

WHITE = (1.0, 1.0, 1.0)
# cascades, brick, degree, lookup
NESTED = [(1, 3, 1, "trilinear"), (2, 1, 0, "trilinear"), (2, 2, 3, "trilinear"), (3, 3, 1, "trilinear"), (3, 4, 2, "nearest"), (2, 2, 0, "nearest")]


def behind(tree: NerfTree, directions: np.ndarray) -> np.ndarray:
    """(R, 3) float64 colours of the environment along rays: their background."""
    assert tree.environment is not None
    return environment.lookup(tree.environment, directions).astype(np.float64)


@pytest.mark.parametrize(("count", "brick", "degree", "lookup"), NESTED)
def test_values_and_gradients_are_those_of_autograd(count: int, brick: int, degree: int, lookup: str) -> None:
    tree = random_cascades(count + brick, count=count, brick=brick, degree=degree, lookup=lookup)
    origins, directions = nested_rays(tree, 240)
    seen = seen_at_random(240, 0.7 if brick > 1 else 0.0)._replace(background=behind(tree, directions))
    loss, by_density, by_sh = gradients(tree, origins, directions, seen)
    wanted, *by_autograd = gradients_by_autograd(replace(tree, environment=None), origins, directions, seen)
    np.testing.assert_allclose(loss, wanted, atol=3e-6)  # the kernel's harmonics are of float32 directions
    for found, expected in zip((by_density, by_sh), by_autograd, strict=True):
        np.testing.assert_allclose(found, expected, atol=2e-5 * np.abs(expected).max())
    for n in range(count):
        assert (by_density[voxel_cascades(tree) == n] != 0).mean() > 0.1


def test_rays_of_hundreds_of_samples_go_on_through_all_cascades() -> None:
    grids = cascade_grids(np.stack([np.zeros(3), np.full(3, 9.6)]), 0.1, 8, 3)
    trees = [uniform_tree(shape, brick=8, voxel=voxel, sigma=0.08 * (n + 1), logit=n - 1.0) for n, (shape, voxel, _) in enumerate(grids)]
    tree = nested([replace(one, bounds_min=low, lookup="nearest") for one, (_, _, low) in zip(trees, grids, strict=True)])
    origins = np.array([[-15.0, 4.7, 4.9], [-14.3, -14.2, -14.1], [4.8, 4.7, 4.6], [24.0, 4.7, 4.9]])
    directions = np.array([[1.0, 0, 0], np.full(3, 3**-0.5), [0, 1.0, 0], [-1.0, 0, 0]])
    colour, opacity, *_ = render_nearest(tree, origins, directions)
    wanted, wanted_opacity = render_reference(tree, *tensors(origins, directions))
    np.testing.assert_allclose(opacity, wanted_opacity, atol=1e-3)
    np.testing.assert_allclose(colour, wanted, atol=1e-3)


@pytest.mark.parametrize(("count", "step_size"), [(1, 0.5), (1, 1.0), (2, 0.5), (3, 0.7)])
def test_nearest_renders_match_the_reference(count: int, step_size: float) -> None:
    tree = replace(random_cascades(count, count=count, brick=4, degree=2, lookup="nearest"), environment=None, step_size=step_size)
    origins, directions = nested_rays(tree, 400)
    colour, opacity, depth, _ = render_nearest(tree, origins, directions)
    wanted, wanted_opacity = render_reference(tree, *tensors(origins, directions))
    np.testing.assert_allclose(opacity, wanted_opacity, atol=1e-3)
    np.testing.assert_allclose(colour, wanted, atol=1e-3)
    np.testing.assert_array_equal(np.isfinite(depth), opacity > 0.5)
    assert 0.2 < (opacity > 0.05).mean() < 0.99


def weights_by_sums(tree: NerfTree, origins: np.ndarray, directions: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """(N,) greatest contributions, sample by sample along `ray_parts`."""
    out, light = np.zeros(len(tree.density_values)), np.ones(len(origins))
    start, along = tensors(origins, directions)
    for n, begin, end in ray_parts(tree, start, along):
        cascade = cascades_of(tree)[n]
        grid = replace(tree, shape=cascade.shape, voxel=cascade.voxel, bounds_min=cascade.bounds_min, brick_index=cascade.brick_index, outer=())
        begin, end = torch.where(begin < end, begin, 0), torch.where(begin < end, end, 0)
        for k in range(1000):
            t = begin + (k + 0.5) * 0.5 * cascade.voxel
            if not (t < end).any():
                break
            points = (start + t[:, None] * along - torch.as_tensor(cascade.bounds_min)) / cascade.voxel
            sigma, index, weight = tree_density(grid, points, torch.from_numpy(tree.density_values).double())
            alpha = np.where(t < end, 1 - np.exp(-sigma.numpy() * 0.5 * cascade.voxel), 0)
            share = np.where(index >= 0, weight.numpy() * (gain * light * alpha)[:, None], 0)
            np.maximum.at(out, np.where(index >= 0, index, 0), share)
            light *= 1 - alpha
    return out


@pytest.mark.parametrize("count", [1, 3])
def test_greatest_weights_are_those_of_plain_sums_in_any_number_of_parts(count: int) -> None:
    tree = random_cascades(3, count=count, brick=3)
    origins, directions = nested_rays(tree, 80)
    gain = np.random.default_rng(0).random(80).astype(np.float32)
    start, along, _ = in_voxels(tree, origins, directions)
    found = []
    for parts in (1, 3):
        into = np.zeros((parts, len(tree.density_values)), np.float32)
        for half in (slice(0, 25), slice(25, 80)):  # what is known is raised
            kernels.max_contributions(cells_of(tree), start[half], along[half], tree.density_values, gain[half], into, stop=0.0)
        found.append(into.max(axis=0))
    np.testing.assert_array_equal(*found)
    np.testing.assert_allclose(found[0], weights_by_sums(tree, origins, directions, gain), atol=1e-5)
    for n in range(count):
        assert (found[0][voxel_cascades(tree) == n] > 0).mean() > 0.1


def fog(environment_map: bool = False) -> NerfTree:
    """Thin grey fog in three cascades, of which the second reaches round the ball of the pictures."""
    grids = cascade_grids(np.stack([np.full(3, -0.4), np.full(3, 0.4)]), 0.1, 2, 3)
    trees = [replace(uniform_tree(s, brick=2, voxel=v, sigma=0.3, logit=0.0), bounds_min=low, background=WHITE) for s, v, low in grids]
    tree = nested(trees, np.ones((4, 8, 3), np.float32) if environment_map else None)
    sh = np.zeros((len(tree.density_values), 4, 3), np.float32)
    return replace(tree, harmonics=sh)


RATES: dict[str, Any] = {"rays": 512, "density_lr": 0.3, "sh_lr": 0.05, "fall": lambda step: 0.1 ** (step / 60), "seed": 1}


def test_nested_fog_becomes_the_ball_of_the_pictures() -> None:
    targets, state = Targets(pixels(10, 24), WHITE), initial_state(fog())
    before = error(state.tree, targets, 2000, 0)
    list(optimise(state, targets, until=60, **RATES))
    tree = state.result()
    assert error(tree, targets, 2000, 0) < 0.1 * before
    assert tree.outer is state.tree.outer
    middle, outermost = (tree.density_values[voxel_cascades(tree) == n] for n in (0, 2))
    assert np.median(outermost) < 0.3 / 2
    assert middle.max() > 3


def test_voxels_are_pruned_by_what_they_weigh_in_every_cascade() -> None:
    targets, state = Targets(pixels(10, 24), WHITE), initial_state(fog())
    list(optimise(state, targets, until=30, **RATES))
    weights = max_weights(state.tree, targets, 4000, 0)
    keep = weights > np.quantile(weights, 0.6)
    fewer = subset_state(state, keep, subset(state.tree, keep))
    assert len(fewer.density) == len(fewer.visits) == keep.sum()
    np.testing.assert_array_equal(voxel_cascades(fewer.tree), voxel_cascades(state.tree)[keep])
    list(optimise(fewer, targets, until=60, **RATES))
    assert error(fewer.result(), targets, 2000, 0) < 0.15 * error(fog(), targets, 2000, 0)


@pytest.mark.parametrize("make", [fog, ball_tree])
def test_the_same_bytes_interrupted_or_not_on_one_thread_or_two(make: Callable[[], NerfTree]) -> None:
    targets = Targets(pixels(6, 16), WHITE)
    whole, parts = initial_state(make()), initial_state(make())
    list(optimise(whole, targets, until=12, **RATES))
    list(optimise(parts, targets, until=5, **RATES))
    with on_threads(1):
        list(optimise(parts, targets, until=12, **RATES))
    for name in ("density", "sh", "square_density", "square_sh", "visits"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))
