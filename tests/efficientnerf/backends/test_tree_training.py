"""Training of a tree in packets of rays: gradients against autograd whatever the packets, steps and total variation against their formulas, the same bytes on
any number of threads."""

from collections.abc import Callable
from dataclasses import replace

import numba
import numpy as np
import pytest

from efficientnerf.asset.cascades import cascade_sides, voxel_cascades, voxel_sides
from efficientnerf.asset.refinement.host import in_voxels, packet_bases
from efficientnerf.asset.refinement.state import initial_state
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.layout import MIN_THICKNESS, MOST_VARIATION
from efficientnerf.backends.numba.tree.cells import cells_of
from efficientnerf.backends.numba.tree_training import gradients as kernels
from efficientnerf.backends.numba.tree_training.gradients import RecordBuffer, packets_of
from efficientnerf.backends.numba.tree_training.neighbours import differences, neighbours_of
from efficientnerf.backends.numba.tree_training.steps import step, values_of
from efficientnerf.backends.numba.vector.memory import pointer
from tests.efficientnerf.refinements import (
    GRIDS,
    gradients,
    gradients_by_autograd,
    moments_of,
    neighbours_by_place,
    records_of,
    rule_of,
    seen_at_random,
    sum_gradients,
)
from tests.efficientnerf.trees import nested_rays, random_cascades, random_tree, rays_at

# brick, degree, lookup
TREES = [(1, 0, "trilinear"), (2, 4, "trilinear"), (4, 2, "trilinear"), (5, 1, "nearest")]


def parallel_rays(tree: NerfTree, count: int, packet: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays of which each packet's go the same way, from near one another."""
    origins, directions = nested_rays(tree, count) if tree.outer else rays_at(tree, count)
    lead = np.arange(count) // packet * packet
    beside = np.random.default_rng(1).uniform(-3, 3, (count, 3)) * tree.voxel
    return origins[lead] + beside, directions[lead]


@pytest.mark.parametrize(("brick", "degree", "lookup", "whole"), [(*TREES[0], True), (*TREES[1], False), (*TREES[2], True), (*TREES[3], False)])
def test_packets_of_parallel_rays_have_the_gradients_of_autograd(brick: int, degree: int, lookup: str, *, whole: bool) -> None:
    tree = random_cascades(1, brick=brick, degree=degree, lookup=lookup) if whole else random_tree(2, brick=brick, degree=degree, lookup=lookup)
    origins, directions = parallel_rays(tree, 150, 16)
    seen = seen_at_random(150, 0.7)._replace(structure=0.3 * brick)
    loss, *found = gradients(tree, origins, directions, seen, packet=16)
    wanted, *wanted_by = gradients_by_autograd(replace(tree, environment=None), origins, directions, seen)
    np.testing.assert_allclose(loss, wanted, atol=3e-6)
    for ours, theirs in zip(found, wanted_by, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=2e-5 * np.abs(theirs).max())
    assert (found[0] != 0).mean() > 0.03


def test_a_packet_grows_until_all_its_rays_fit() -> None:
    """All rays of a large tree in one packet: many times the blocks and samples that it begins with."""
    tree = random_tree(3, shape=(7, 7, 7), brick=2, degree=0, share=0.9, sigma=0.5)
    origins, directions = rays_at(tree, 600)
    seen = seen_at_random(600, 0.2)
    one, all_at_once = gradients(tree, origins, directions, seen), gradients(tree, origins, directions, seen, packet=600)
    for a, b in zip(one, all_at_once, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12 * np.abs(a).max())
    assert (one[1] != 0).sum() > 2 * kernels.FIRST_BLOCKS


@pytest.mark.parametrize("made", GRIDS)
def test_steps_are_those_of_the_formula(made: Callable[[], NerfTree]) -> None:
    tree = made()
    sides, o = voxel_sides(tree), initial_state(tree)
    rates = np.where(np.arange(o.sh.shape[1]) < 3, 0.01, 0.005)
    moments, count = moments_of(o), len(o.density)
    density, sh = o.density.astype(np.float64), o.sh.astype(np.float64)
    square_density, square_sh, visits = np.zeros(count), np.zeros(count), np.zeros(count)
    for number in (1, 2, 3):
        records = records_of(tree, o, number)
        by_density, by_sh = np.zeros_like(o.density), np.zeros_like(o.sh)
        sum_gradients(records, by_density, by_sh)
        values = values_of(cells_of(tree), o.density, o.sh)
        step(records, values, moments, rule_of())
        np.testing.assert_array_equal(values.dense[values.places], o.density)
        met = np.zeros(count, bool)
        for begin, end in zip(records.begin[:, 0], records.begin[:, -1], strict=True):
            met[records.numbers[begin:end, 0]] = True
        visits += met
        slope, flat = by_density * np.maximum(density, MIN_THICKNESS / sides), by_sh
        square_density = np.where(met, 0.9 * square_density + 0.1 * slope**2, square_density)
        square_sh = np.where(met, 0.9 * square_sh + 0.1 * (flat**2).mean(axis=1), square_sh)
        right = np.maximum(1 - 0.9**visits, 1e-30)
        density = np.where(met, density * np.exp(-0.1 * slope / (np.sqrt(square_density / right) + 1e-12)), density)
        sh -= met[:, None] * rates * flat / (np.sqrt(square_sh / right) + 1e-12)[:, None]
        np.testing.assert_array_equal(o.visits, visits)
        np.testing.assert_allclose(o.density, density, rtol=2e-3, atol=1e-5)
        np.testing.assert_allclose(o.sh, sh, atol=2e-3)
    assert len(np.unique(visits)) > 1  # some were not met by every bundle


def test_the_same_bytes_on_any_number_of_threads() -> None:
    tree, found = random_cascades(3, cells=8, brick=2, degree=2), []
    threads = numba.get_num_threads()
    origins, directions = nested_rays(tree, 1500)
    seen = seen_at_random(1500, 0.2, np.float32)
    start, along, bases = in_voxels(tree, origins, directions)
    first = packets_of(1500, 7)
    try:
        for count in (1, threads):
            numba.set_num_threads(count)
            o = initial_state(tree)
            moments, cells = moments_of(o), cells_of(tree)
            values = values_of(cells, o.density, o.sh)
            for _ in range(2):
                loss, records = kernels.forward_backward(cells, first, start, along, packet_bases(bases, first), values.dense, values.sh, seen, RecordBuffer())
                step(records, values, moments, rule_of())
            found.append((loss, o.density, o.sh, *moments))
    finally:
        numba.set_num_threads(threads)
    for a, b in zip(*found, strict=True):
        np.testing.assert_array_equal(a, b)


@numba.njit
def _slope_at(place, thickness, side, least, brick, dense, around):  # type: ignore[no-untyped-def]
    return differences(place, thickness, side, least, brick, pointer(dense), pointer(around))


@pytest.mark.parametrize(("made", "weight"), [(GRIDS[0], 0.5), (GRIDS[1], 1e3)])
def test_total_variation_takes_its_slope_apart_from_the_moments(made: Callable[[], NerfTree], weight: float) -> None:
    tree = made()
    noisy = replace(tree, density_values=np.random.default_rng(0).uniform(1, 30, len(tree.density_values)).astype(np.float32))
    plain, smooth = initial_state(noisy), initial_state(noisy)
    cells = cells_of(tree)
    old = np.log(plain.density.astype(np.float64) * voxel_sides(tree))
    for o, more in ((plain, {}), (smooth, {"total_variation": weight})):
        step(records_of(tree, o, 1), values_of(cells, o.density, o.sh), moments_of(o), rule_of(**more), neighbours_of(cells))
    np.testing.assert_array_equal(plain.square_density, smooth.square_density)
    moved = np.log(plain.density / smooth.density)
    share, beside = min(rule_of().density_rate * weight, MOST_VARIATION), neighbours_by_place(tree)
    slope = np.where(beside >= 0, old[:, None] - old[beside], 0).sum(axis=1)
    np.testing.assert_allclose(moved, np.where(plain.visits > 0, share * slope, 0), rtol=2e-3, atol=1e-5)


@pytest.mark.parametrize("made", GRIDS, ids=["one grid", "cascades"])
def test_values_know_their_voxels(made: Callable[[], NerfTree]) -> None:
    tree = made()
    values = values_of(cells_of(tree), tree.density_values, tree.sh.reshape(len(tree.sh), -1))
    np.testing.assert_array_equal(values.cascades, voxel_cascades(tree))
    np.testing.assert_allclose(values.sides, cascade_sides(tree), rtol=1e-15)
    np.testing.assert_array_equal(values.dense[values.places], tree.density_values)
    assert np.signbit(values.dense).sum() == len(values.dense) - len(values.density)


@pytest.mark.parametrize("degree", [0, 2, 4])
def test_rows_of_any_length_take_their_own_gradient_and_no_other(degree: int) -> None:
    """Rows lie end to end, and the groups of sixteen numbers that a step works in reach beyond them."""
    tree = random_tree(6, brick=2, degree=degree)
    o = initial_state(tree)
    records, before = records_of(tree, o, 1), o.sh.copy()
    by_density, by_sh = np.zeros(o.density.shape), np.zeros(o.sh.shape)
    sum_gradients(records, by_density, by_sh)
    step(records, values_of(cells_of(tree), o.density, o.sh), moments_of(o), rule_of())
    met = o.visits > 0
    assert 0 < met.sum() < len(met)
    np.testing.assert_array_equal(o.sh[~met], before[~met])
    size = np.sqrt((by_sh**2).mean(axis=1, keepdims=True))
    np.testing.assert_allclose((before - o.sh)[met], (np.where(np.arange(by_sh.shape[1]) < 3, 0.01, 0.005) * by_sh / (size + 1e-12))[met], rtol=1e-3, atol=2e-6)
    np.testing.assert_allclose(np.sqrt(o.square_sh / 0.1)[met], size[met, 0], rtol=1e-4)


@pytest.mark.parametrize(("made", "brick"), [(random_tree, 1), (random_tree, 4), (random_cascades, 3)])
def test_voxels_without_density_are_neighbours_and_absent_ones_are_not(made: Callable[..., NerfTree], brick: int) -> None:
    tree = made(7, brick=brick, degree=0)
    density = np.random.default_rng(0).uniform(1, 30, len(tree.density_values)).astype(np.float32)
    density[::3] = 0
    tree = replace(tree, density_values=density)
    cells, sides = cells_of(tree), voxel_sides(tree)
    values, beside = values_of(cells, density, tree.sh.reshape(len(density), -1)), neighbours_of(cells)
    thickness, others = np.maximum(density * sides, MIN_THICKNESS), neighbours_by_place(tree)
    wanted = np.where(others >= 0, np.log(thickness[:, None] / thickness[others]), 0).sum(axis=1)
    for v in np.random.default_rng(1).choice(len(density), min(40, len(density)), replace=False):
        found = _slope_at(values.places[v], thickness[v], sides[v], MIN_THICKNESS, beside.brick, values.dense, beside.around)
        assert found == pytest.approx(wanted[v], rel=1e-5, abs=1e-5)
    assert len(set((others >= 0).sum(axis=1))) > 1
