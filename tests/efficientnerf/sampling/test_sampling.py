"""Valid and pivotal samples: loop, torch and kernel agree; pivotal slots tile their intervals; nothing is evaluated twice."""

import math

import numpy as np
import pytest
import torch

from efficientnerf.backends import dispatch
from efficientnerf.geometry.spaces import BoundedSpace, ContractedSpace, space_from
from efficientnerf.rendering.compositing import ray_of_sample
from tests import reference
from tests.efficientnerf.coarse_rays import BOUNDS, SIDE, STEP, Rays, coarse_samples_of, make_rays, voxels_of


@pytest.mark.parametrize("contracted", [False, True])
@pytest.mark.parametrize("lost", [float("nan"), float("inf"), 3e38])
def test_a_ray_that_is_nowhere_leaves_its_neighbours_alone(contracted: bool, lost: float) -> None:
    """The kernel takes rays sixteen at a time; none may make it read voxels that do not exist."""
    rays, space = make_rays("outside"), space_from(BOUNDS, contracted=contracted)
    alone = dispatch.valid_samples(space, *rays, STEP, 60, voxels_of(), 0.4)
    odd = Rays(rays.origins.clone(), rays.directions.clone(), *rays[2:])
    odd.origins[20, 1] = odd.directions[40] = lost
    found = dispatch.valid_samples(space, *odd, STEP, 60, voxels_of(), 0.4)
    for r in set(range(60)) - {20, 40}:
        ours, theirs = slice(*found.first[r : r + 2].tolist()), slice(*alone.first[r : r + 2].tolist())
        assert torch.equal(found.start[ours], alone.start[theirs])
        assert torch.equal(found.point[ours], alone.point[theirs])


@pytest.mark.parametrize("contracted", [False, True])
def test_the_first_rays_can_be_left_unpruned(contracted: bool) -> None:
    rays, space, find = make_rays("outside"), space_from(BOUNDS, contracted=contracted), dispatch.valid_samples
    some = find(space, *rays, STEP, 60, voxels_of(), 0.4, unpruned=7)
    parts = [find(space, *(t[which] for t in rays), STEP, 60, voxels_of(), threshold) for which, threshold in ((slice(7), -math.inf), (slice(7, None), 0.4))]
    assert torch.equal(some.first, torch.cat([parts[0].first, parts[1].first[1:] + parts[0].first[-1]]))
    for ours, *theirs in zip(some[1:5], parts[0][1:5], parts[1][1:5], strict=True):
        assert torch.equal(ours, torch.cat(theirs))
    assert some.tried == parts[0].tried + parts[1].tried
    assert len(parts[0].start) == parts[0].tried > 0


def test_a_voxel_at_the_threshold_is_not_valid() -> None:
    rays = make_rays("outside")
    space, voxels = BoundedSpace(BOUNDS), torch.full((SIDE, SIDE, SIDE), 0.5)
    find = dispatch.valid_samples
    assert len(find(space, *rays, STEP, 60, voxels, 0.5).start) == 0
    above = find(space, *rays, STEP, 60, voxels, 0.5 - 1e-6)
    assert len(above.start) == above.tried > 0


@pytest.mark.parametrize("contracted", [False, True])
def test_intervals_lie_end_to_end_and_samples_in_them(contracted: bool) -> None:
    rays, space = make_rays("outside"), space_from(BOUNDS, contracted=contracted)
    rays = rays._replace(far=torch.full_like(rays.far, 1e6))
    found = dispatch.valid_samples(space, *rays, STEP, 200, voxels_of(), -math.inf)
    ray = ray_of_sample(found.first, len(found.start))
    same = ray[1:] == ray[:-1]
    torch.testing.assert_close((found.start + found.extent)[:-1][same], found.start[1:][same], rtol=1e-5, atol=1e-5)
    at = found.start + rays.offset[ray] * found.extent
    torch.testing.assert_close(found.point, space.grid(rays.origins[ray] + at[:, None] * rays.directions[ray]), rtol=0, atol=1e-5)
    last = torch.zeros_like(found.start, dtype=torch.bool)
    last[found.first[1:][found.first[1:] > found.first[:-1]] - 1] = True
    torch.testing.assert_close(found.length[~last], torch.full_like(found.length[~last], STEP))
    assert (found.length[last] <= STEP * 1.0001).all()
    if not contracted:
        assert found.point.min() >= -1e-5  # nothing beyond the box
        assert found.point.max() <= 1 + 1e-5
        chord = (found.start + found.extent)[last] - found.start[found.first[:-1][found.first[1:] > found.first[:-1]]]
        torch.testing.assert_close(torch.zeros(len(rays.far)).index_add(0, ray, found.extent)[ray[last]], chord, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("coarse_samples", [16, 128])
@pytest.mark.parametrize("half", [(1, 1, 1), (1, 0.3, 0.1), (0.1, 1, 1)])
def test_a_ray_through_all_of_contracted_space_fits_its_slots(coarse_samples: int, half: tuple[float, float, float]) -> None:
    from efficientnerf.model import model
    from efficientnerf.training.settings import TrainSettings

    space = ContractedSpace(np.array([np.negative(half), half]))
    m = model(space, TrainSettings(num_coarse_samples=coarse_samples, occupancy_resolution=8, num_levels=2, log2_hashmap_size=8), None)
    rng = np.random.default_rng(5)
    directions = rng.normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = torch.from_numpy((rng.uniform(-1.5, 1.5, (300, 3)) - 3 * directions).astype(np.float32))
    along = torch.from_numpy(directions.astype(np.float32))
    ones = torch.ones(300)
    found = dispatch.valid_samples(space, origins, along, 0.01 * ones, 1e9 * ones, 0.5 * ones, m.step, m.max_intervals, m.voxels.values, -math.inf)
    last = found.first[1:] - 1
    reach = space.unit(origins + (found.start + found.extent)[last][:, None] * along).abs().amax(dim=1)
    assert reach.min() > reference.FARTHEST


@pytest.mark.parametrize(("contracted", "per_pivot"), [(False, 1), (True, 4), (False, 5)])
def test_pivotal_slots_tile_their_intervals(contracted: bool, per_pivot: int) -> None:
    rays = make_rays("outside")
    space, coarse, pivotal = coarse_samples_of(rays, contracted)
    fine = dispatch.pivotal_samples(space, rays.origins, rays.directions, rays.offset, coarse, pivotal, per_pivot)
    pivots, ray = int(pivotal.sum()), ray_of_sample(coarse.first, len(pivotal))[pivotal]
    assert fine.first.tolist() == [0, *(per_pivot * torch.bincount(ray, minlength=len(rays.origins))).cumsum(0).tolist()]
    start, extent = fine.start.reshape(pivots, per_pivot), fine.extent.reshape(pivots, per_pivot)
    torch.testing.assert_close(start[:, 0], coarse.start[pivotal])
    torch.testing.assert_close((start + extent)[:, :-1], start[:, 1:])
    torch.testing.assert_close(extent.sum(1), coarse.extent[pivotal])
    torch.testing.assert_close(fine.length.reshape(pivots, per_pivot).sum(1), coarse.length[pivotal])
    of = ray_of_sample(fine.first, len(fine.start))
    at = fine.start + rays.offset[of] * fine.extent
    torch.testing.assert_close(fine.point, space.grid(rays.origins[of] + at[:, None] * rays.directions[of]), rtol=0, atol=1e-5)
