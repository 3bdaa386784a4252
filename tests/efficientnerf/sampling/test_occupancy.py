"""Momentum density voxels: equation 7 against the loop, the other rule, the threshold, and how pruned space returns."""

import numpy as np
import pytest
import torch

from efficientnerf.backends import dispatch
from efficientnerf.rendering.compositing import activate
from efficientnerf.sampling.occupancy import (
    apply_decay,
    cell_of,
    density_voxels,
    mask_cells,
    random_cells,
    update,
)
from tests import reference

SIDE = 3


def samples(count: int = 80) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(count)
    return torch.from_numpy(rng.integers(0, SIDE**3 - 4, count)), torch.from_numpy(rng.normal(size=count).astype(np.float32) * 20)


def test_momentum_is_equation_seven_with_one_update_to_a_voxel() -> None:
    voxels = density_voxels(SIDE, "momentum", initial=10.0, beta=0.1)
    expected = [10.0] * SIDE**3
    for count in (80, 1, 200):
        cell, density = samples(count)
        update(voxels, cell, density)
        expected = reference.momentum(expected, cell.tolist(), density.tolist(), 0.1)
    np.testing.assert_allclose(voxels.values.reshape(-1), expected, rtol=1e-5)
    assert voxels.values.reshape(-1)[-1] == 10.0  # never updated


@pytest.mark.parametrize("activation", ["exp", "softplus"])
def test_samples_tell_the_largest_in_one_go_as_they_do_step_by_step(activation: str) -> None:
    rng = np.random.default_rng(0)
    side = 7
    ours, theirs = (density_voxels(side, "maximum", threshold=0.2) for _ in range(2))
    for voxels in (ours, theirs):
        mask_cells(voxels, torch.arange(side**3).reshape(side, side, side) % 5 == 0)
    for count in (0, 1, 3000):
        point = torch.from_numpy(rng.uniform(-0.05, 1.05, (count, 3)).astype(np.float32))  # beyond the faces, too: these are of the outermost voxels
        raw = torch.from_numpy(rng.normal(size=(count, 4)).astype(np.float32) * 6)[:, 0]
        dispatch.update_occupancy_maximum(ours.values, point, raw, activation)
        update(theirs, cell_of(point, side), activate(raw, activation))
        torch.testing.assert_close(ours.values, theirs.values, rtol=1e-5, atol=1e-6)


def test_a_voxel_of_raw_density_minus_five_is_pruned_at_its_eleventh_visit() -> None:
    voxels = density_voxels(1, "momentum", initial=10.0, beta=0.1)
    visits = 0
    while voxels.occupied:
        update(voxels, torch.zeros(1, dtype=torch.int64), torch.tensor([-5.0]))
        visits += 1
    assert visits == 11


def test_maximum_keeps_the_largest_and_forgets() -> None:
    voxels = density_voxels(SIDE, "maximum", decay=0.5, threshold=1.0)
    assert (voxels.values == 2).all()
    cell, density = samples()
    update(voxels, cell, density)
    apply_decay(voxels)
    expected = [max([2.0, *density[cell == n].tolist()]) / 2 for n in range(SIDE**3)]
    np.testing.assert_allclose(voxels.values.reshape(-1), expected, rtol=1e-6)


@pytest.mark.parametrize("padded", [False, True])
@pytest.mark.parametrize(("rule", "beta", "decay"), [("momentum", 1.0, 0.5), ("momentum", 0.1, 0.5), ("maximum", 0.1, 0.0), ("maximum", 0.1, 0.95)])
def test_masked_voxels_stay_masked_and_change_no_others(rule: str, beta: float, decay: float, padded: bool) -> None:
    voxels, plain = (density_voxels(SIDE, rule, threshold=1.0, beta=beta, decay=decay) for _ in range(2))
    masked = torch.zeros(SIDE, SIDE, SIDE, dtype=torch.bool)
    masked[1] = True
    mask_cells(voxels, masked)
    for _ in range(3):
        cell, density = samples()
        for each in (voxels, plain):
            update(each, cell, density, torch.tensor(len(cell)) if padded else None)
            apply_decay(each)
    assert torch.isneginf(voxels.values[masked]).all()
    assert torch.equal(voxels.values[~masked], plain.values[~masked])
    assert voxels.occupied == float((plain.values[~masked] > plain.threshold).sum()) / SIDE**3


def test_cells_hold_their_points_and_the_borders_belong_to_the_grid() -> None:
    point = torch.tensor([[0.0, 0.0, 0.0], [0.99, 0.0, 0.34], [1.0, 1.0, 1.0], [-0.1, 0.5, 1.2]])
    assert cell_of(point, SIDE).tolist() == [0, 19, 26, 5]


@pytest.mark.parametrize(("rule", "empty", "full", "threshold"), [("momentum", -40.0, 40.0, 0.0), ("maximum", 0.0, 40.0, 1.0)])
def test_updates_at_random_cells_let_pruned_space_return(rule: str, empty: float, full: float, threshold: float) -> None:
    """The field is empty until all is pruned, then full: no ray is sampled any more, and yet voxels become valid again."""
    voxels = density_voxels(6, rule, threshold=threshold)
    shares = []
    for density in (empty, full):
        for seed in range(300):
            apply_decay(voxels)
            cell, _ = random_cells(voxels, 20, seed)
            update(voxels, cell, torch.full((len(cell),), density))
        shares.append(voxels.occupied)
    assert shares[0] == 0.0
    assert shares[1] > 0.9
