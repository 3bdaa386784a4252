"""Valid and pivotal samples by the CUDA kernels against torch, with and without a fixed capacity."""

import math

import pytest
import torch

from efficientnerf.geometry.spaces import BoundedSpace, space_from
from efficientnerf.sampling import pivotal as pivotal_sampling
from efficientnerf.sampling.samples import Samples
from tests.efficientnerf.coarse_rays import BOUNDS, STEP, Rays, coarse_samples_of, make_rays, voxels_of
from tests.efficientnerf.device import DEVICE

cuda = pytest.importorskip("efficientnerf.backends.triton.sampling")


def there(rays: Rays) -> Rays:
    return Rays(*(t.to(DEVICE) for t in rays))


def here(samples: Samples) -> Samples:
    return Samples(*(t.cpu() for t in samples[:5]), int(samples.tried), None if samples.complete is None else samples.complete.cpu())


def of_ray(samples: Samples, r: int) -> list[torch.Tensor]:
    begin, end = samples.first[r : r + 2].tolist()
    return [t[begin:end] for t in samples[1:5]]


@pytest.mark.parametrize(("contracted", "room"), [(False, 0), (False, 100), (True, 100), (True, 4000)])
def test_a_capacity_cuts_off_the_end_or_pads_it(contracted: bool, room: int) -> None:
    rays, space = there(make_rays("outside")), space_from(BOUNDS, contracted=contracted)
    args = (space, *rays, STEP, 60, voxels_of().to(DEVICE), 0.4)
    whole, cut = cuda.valid_samples(*args), cuda.valid_samples(*args, capacity=room)
    total = int(whole.first[-1])
    assert whole.complete is None
    assert cut.complete is not None
    assert torch.equal(cut.complete, whole.first[1:] <= room)
    assert 100 < total < 4000
    kept = min(room, total)
    assert torch.equal(cut.first, whole.first.clamp(max=room))
    for a, b in zip(cut[1:5], whole[1:5], strict=True):
        assert len(a) == room
        assert torch.equal(a[:kept], b[:kept])
        assert not a[kept:].any()
    assert isinstance(cut.tried, torch.Tensor)
    assert int(cut.tried) == whole.tried


@pytest.mark.parametrize(("contracted", "room"), [(False, None), (True, 300), (False, 4000)])
def test_the_first_rays_can_be_left_unpruned(contracted: bool, room: int | None) -> None:
    rays, space = there(make_rays("outside")), space_from(BOUNDS, contracted=contracted)
    args = (space, *rays, STEP, 60, voxels_of().to(DEVICE))
    some = here(cuda.valid_samples(*args, 0.4, room, unpruned=5))
    every, pruned = (here(cuda.valid_samples(*args, threshold)) for threshold in (-math.inf, 0.4))
    for r in range(len(rays.origins)):
        begin, end = some.first[r : r + 2].tolist()
        if room is not None and end == room:  # no more than this finds room
            break
        for ours, theirs in zip(of_ray(some, r), of_ray(every if r < 5 else pruned, r), strict=True):
            assert torch.equal(ours, theirs)
        assert begin < end or r >= 5
    assert r > 5
    assert some.tried == every.tried


@pytest.mark.parametrize(("contracted", "per_pivot", "room"), [(False, 1, 50), (True, 3, 50), (False, 3, 0), (True, 3, 5000)])
def test_pivotal_samples_are_those_of_torch_cut_off_or_padded(contracted: bool, per_pivot: int, room: int) -> None:
    rays = make_rays("inside")
    space, coarse, pivotal = coarse_samples_of(rays, contracted)
    theirs = pivotal_sampling.pivotal_samples(space, rays.origins, rays.directions, rays.offset, coarse, pivotal, per_pivot)
    padded, marked = coarse, pivotal
    if room is not None:  # what comes of a coarse stage with a capacity: padding, and the choice of padding by chance
        more = [torch.cat([t, t.new_zeros(40, *t.shape[1:])]) for t in coarse[1:5]]
        padded, marked = Samples(coarse.first, *more, coarse.tried), torch.cat([pivotal, torch.ones(40, dtype=torch.bool)])
    at = there(rays)
    on_device = Samples(*(t.to(DEVICE) for t in padded[:5]), padded.tried)
    ours = here(cuda.pivotal_samples(space, at.origins, at.directions, at.offset, on_device, marked.to(DEVICE), per_pivot, room))
    kept = len(theirs.start) if room is None else min(room, len(theirs.start))
    assert torch.equal(ours.first, theirs.first.clamp(max=kept))
    assert (ours.complete is None) == (room is None)
    for a, b in zip(ours[1:5], theirs[1:5], strict=True):
        assert len(a) == (kept if room is None else room)
        torch.testing.assert_close(a[:kept], b[:kept], rtol=1e-4, atol=1e-5)
        assert not a[kept:].any()


def test_no_rays_no_slots_and_no_samples_are_fine() -> None:
    voxels = voxels_of().to(DEVICE)
    none = there(Rays(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0), torch.zeros(0), torch.zeros(0)))
    for room in (None, 4):
        found = cuda.valid_samples(BoundedSpace(BOUNDS), *none, STEP, 60, voxels, 0.4, room)
        assert found.first.tolist() == [0]
        assert found.point.shape == (room or 0, 3)
    rays, space = there(make_rays("outside")), BoundedSpace(BOUNDS)
    empty = cuda.valid_samples(space, *rays, STEP, 0, voxels, 0.4)
    assert not empty.first.any()
    assert cuda.select_pivots(empty.start, empty.first, 0.1, 3).shape == (0,)
    fine = cuda.pivotal_samples(space, rays.origins, rays.directions, rays.offset, empty, torch.zeros(0, dtype=torch.bool, device=DEVICE), 2)
    assert not fine.first.any()
    assert fine.point.shape == (0, 3)
