"""Optimiser steps of the CUDA kernels against the CPU's, and total variation against its formula."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from efficientnerf.asset.cascades import voxel_sides
from efficientnerf.asset.refinement.state import RefinementState, initial_state
from efficientnerf.asset.tree import NerfTree
from efficientnerf.backends.layout import MOST_VARIATION
from efficientnerf.backends.numba.tree.cells import cells_of
from efficientnerf.backends.numba.tree_training import steps as host
from efficientnerf.backends.numba.tree_training.neighbours import NO_NEIGHBOURS, neighbours_of
from tests.efficientnerf.device import DEVICE
from tests.efficientnerf.refinements import GRIDS, moments_of, neighbours_by_place, records_of, rule_of, sum_gradients

device = pytest.importorskip("efficientnerf.backends.triton.tree_steps")
refinement = pytest.importorskip("efficientnerf.asset.refinement.device")
kernels = pytest.importorskip("efficientnerf.backends.triton.tree_gradients")

RAYS = 100


def sent(values: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.array(values)).to(DEVICE)


class OnDevice:
    """A state on the device, and steps of it from given gradients."""

    def __init__(self, tree: NerfTree, state: RefinementState, *, smooth: bool) -> None:
        self.grid = kernels.device_grid(tree, DEVICE)
        self.values = sent(state.density), sent(state.sh)
        self.moments = device.Moments(sent(state.square_density), sent(state.square_sh), sent(state.visits))
        beside = sent(refinement.voxels_beside(tree) if smooth else np.zeros((0, 6), np.int32))
        self.neighbours = device.Neighbours(torch.zeros(len(beside), device=DEVICE), beside)

    def step(self, by_thickness: np.ndarray, by_sh: np.ndarray, met: np.ndarray, number: int, **more: Any) -> None:
        scale = kernels.fixed_point_scale(RAYS)
        sums = tuple(sent(np.rint(by.astype(np.float64) * scale).astype(np.int64)) for by in (by_thickness, by_sh))
        stamp = sent(np.where(met, number, number - 1).astype(np.int32))
        rule = rule_of(**more)
        device.step(self.grid, self.values, sums, self.moments, stamp, rule, self.neighbours, number=number, rays=RAYS)
        for part in sums:
            assert not part.cpu().numpy()[met].any()  # ready for the next step


TERMS: list[dict[str, Any]] = [{}, {"total_variation": 0.7}]


@pytest.mark.parametrize(("made", "more"), [(GRIDS[n % 2], more) for n, more in enumerate(TERMS)])
def test_steps_are_those_of_the_cpu(made: Callable[[], NerfTree], more: dict[str, Any]) -> None:
    tree = made()
    o, smooth = initial_state(tree), "total_variation" in more
    there = OnDevice(tree, o, smooth=smooth)
    cells = cells_of(tree)
    moments, neighbours = moments_of(o), neighbours_of(cells) if smooth else NO_NEIGHBOURS
    rule = rule_of(**more)
    for number in (1, 2, 3):
        records = records_of(tree, o, number)
        by_density, by_sh = np.zeros_like(o.density), np.zeros_like(o.sh)
        sum_gradients(records, by_density, by_sh)
        met = np.zeros(len(o.density), bool)
        for begin, end in zip(records.begin[:, 0], records.begin[:, -1], strict=True):
            met[records.numbers[begin:end, 0]] = True
        host.step(records, host.values_of(cells, o.density, o.sh), moments, rule, neighbours)
        there.step(by_density / voxel_sides(tree), by_sh, met, number, **more)
        for ours, theirs in zip((*there.values, *there.moments), (o.density, o.sh, *moments), strict=True):
            if theirs.size:
                np.testing.assert_allclose(ours.cpu().numpy(), theirs, rtol=2e-4, atol=2e-5 * np.abs(theirs).max())
    assert len(np.unique(o.visits)) > 1  # some were not met by every bundle


@pytest.mark.parametrize(("made", "weight"), [(GRIDS[0], 0.7), (GRIDS[1], 1e3)])
def test_total_variation_takes_its_slope_apart_from_the_moments(made: Callable[[], NerfTree], weight: float) -> None:
    tree = made()
    sides = voxel_sides(tree)
    thickness = np.random.default_rng(0).permutation(np.geomspace(1e-3, 20, len(sides)))
    o = initial_state(replace(tree, density_values=(thickness / sides).astype(np.float32)))
    there = OnDevice(tree, o, smooth=True)
    there.step(np.zeros_like(o.density), np.zeros_like(o.sh), np.ones(len(sides), bool), 1, total_variation=weight)
    logarithm, beside = np.log(o.density.astype(np.float64) * sides), neighbours_by_place(tree)
    slope = np.where(beside >= 0, logarithm[:, None] - logarithm[beside], 0).sum(axis=1)
    moved = np.log(there.values[0].cpu().numpy().astype(np.float64) / o.density)
    np.testing.assert_allclose(moved, -min(0.1 * weight, MOST_VARIATION) * slope, rtol=1e-3, atol=1e-5)
    assert not there.moments.square_density.any()
    assert np.abs(moved).max() > 0.1
