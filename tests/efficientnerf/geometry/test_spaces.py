"""World to grid: inverses, the contraction's closed form, and what it leaves alone."""

import numpy as np
import pytest
import torch

from efficientnerf.geometry.spaces import contract, space_from, voxel_centres
from tests import reference

BOUNDS = np.array([[-1.0, -0.4, 0.2], [0.5, 0.9, 0.8]])


@pytest.fixture
def points() -> torch.Tensor:
    rng = np.random.default_rng(0)
    return torch.from_numpy(rng.normal(size=(500, 3)) * 10.0 ** rng.uniform(-2, 2, (500, 1)))


def test_contraction_is_the_papers(points: torch.Tensor) -> None:
    expected = [reference.contract(u) for u in points.tolist()]
    torch.testing.assert_close(contract(points), torch.tensor(expected, dtype=torch.float64))
    inside = points / points.abs().amax(dim=1, keepdim=True) * 0.999
    assert torch.equal(contract(inside), inside)


@pytest.mark.parametrize("contracted", [False, True])
def test_world_is_the_inverse_of_grid(points: torch.Tensor, contracted: bool) -> None:
    space = space_from(BOUNDS, contracted=contracted)
    world = torch.as_tensor(space.world(torch.from_numpy(np.random.default_rng(1).uniform(0.02, 0.98, (500, 3)))))
    torch.testing.assert_close(space.world(space.grid(world)), world)
    if contracted:
        torch.testing.assert_close(space.world(space.grid(points)), points)
        assert space.grid(points).min() >= 0
        assert space.grid(points).max() <= 1


@pytest.mark.parametrize(("contracted", "low", "high"), [(False, 0.0, 1.0), (True, 0.25, 0.75)])
def test_the_box_lies_where_it_should(contracted: bool, low: float, high: float) -> None:
    corners = space_from(BOUNDS, contracted=contracted).grid(torch.from_numpy(BOUNDS))
    torch.testing.assert_close(corners, torch.tensor([[low] * 3, [high] * 3], dtype=torch.float64))


@pytest.mark.parametrize("contracted", [False, True])
def test_voxel_centres_are_those_of_a_baked_grid(contracted: bool) -> None:
    from efficientnerf.asset.bake import grid_of

    space = space_from(BOUNDS, contracted=contracted)
    shape, side = grid_of(BOUNDS, 10, 1)
    at = np.random.default_rng(0).uniform(BOUNDS[0] - 0.3, BOUNDS[1] + 0.3, (2000, 3))
    inside = ((at > BOUNDS[0]) & (at < BOUNDS[1])).all(axis=1)
    found = space.world(voxel_centres(space, space.grid(torch.from_numpy(at)), 10)).numpy()
    index = np.floor((at[inside] - BOUNDS[0]) / side)
    assert (index < shape).all()
    np.testing.assert_allclose(found[inside], BOUNDS[0] + (index + 0.5) * side, atol=1e-9)
    np.testing.assert_allclose(found[~inside], at[~inside], atol=1e-9)  # nothing is baked there
    # A centre is where it is taken to, to the last bit, and the box's corners have voxels.
    centres = voxel_centres(space, space.grid(torch.from_numpy(at[inside]).float()), 10)
    within = (space.unit(space.world(centres)).abs() <= 1).all(dim=1)  # the last voxels may reach beyond the box
    assert torch.equal(voxel_centres(space, centres, 10)[within], centres[within])
    corners = space.world(voxel_centres(space, space.grid(torch.from_numpy(BOUNDS)), 10)).numpy()
    np.testing.assert_allclose(corners, BOUNDS[0] + (np.array([[0, 0, 0], np.array(shape) - 1]) + 0.5) * side, atol=1e-9)
