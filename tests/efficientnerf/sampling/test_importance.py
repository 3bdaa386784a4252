"""NeRF's samplings: even and by importance, their laws, a loop, and gradients of every sampler's differentiable part."""

import math

import numpy as np
import pytest
import torch

from efficientnerf.geometry.spaces import BoundedSpace, ContractedSpace
from efficientnerf.model import render_rays
from efficientnerf.rendering.field_renderer import valid_count
from efficientnerf.sampling.hierarchical import IMPORTANCE_FLOOR, importance_samples, stratified_samples
from efficientnerf.sampling.pivotal import pivotal_samples
from efficientnerf.sampling.samples import Samples
from efficientnerf.sampling.valid import valid_samples
from efficientnerf.training.optimiser import parameter_groups
from tests.efficientnerf.balls import pixels, untrained

BOUNDS = np.array([[-1.0] * 3, [1.0] * 3])
SPACE = BoundedSpace(BOUNDS)


def rays(count: int = 12, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Some hit the box, the last goes past it."""
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(count, 3, generator=generator, dtype=dtype) - 0.5
    origins = target + torch.tensor([3.0, 0.2, 0.1], dtype=dtype)
    directions = torch.nn.functional.normalize(target - origins + 0.1 * torch.rand(count, 3, generator=generator, dtype=dtype), dim=1)
    directions[-1] = torch.tensor([0.0, 0.0, 1.0])
    return origins, directions, torch.full((count,), 1.0, dtype=dtype), torch.full((count,), 5.0, dtype=dtype)


def pruned(drop: float = 0.5) -> tuple[Samples, torch.Tensor]:
    """Valid samples with gaps, and their distances."""
    o, d, near, far = rays()
    voxels = torch.rand(6, 6, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    offset = torch.rand(len(o), generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    found = valid_samples(SPACE, o, d, near, far, offset, 0.2, 40, voxels, drop)
    ray = sampling_ray(found)
    return found, found.start + offset[ray] * found.extent


def sampling_ray(samples: Samples) -> torch.Tensor:
    return torch.repeat_interleave(torch.arange(len(samples.first) - 1), samples.first.diff())


def test_even_samples_tile_the_ray() -> None:
    o, d, near, far = rays()
    jitter = torch.rand(len(o), 10, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    samples, at = stratified_samples(SPACE, o, d, near, far, jitter, outside=True)
    assert samples.first.tolist() == list(range(0, 10 * len(o) + 1, 10))
    torch.testing.assert_close(samples.extent, torch.full_like(at, 0.4))
    torch.testing.assert_close(samples.start.reshape(-1, 10)[:, 1:], (samples.start + samples.extent).reshape(-1, 10)[:, :-1])
    assert ((at >= samples.start) & (at <= samples.start + samples.extent)).all()
    torch.testing.assert_close(SPACE.world(samples.point), (o[:, None] + at.reshape(-1, 10, 1) * d[:, None]).reshape(-1, 3))
    inside, _ = stratified_samples(SPACE, o, d, near, far, jitter, outside=False)
    assert 0 < len(inside.start) < len(samples.start)
    assert ((inside.point >= 0) & (inside.point <= 1)).all()
    assert inside.first[-1] == inside.first[-2]  # the last ray misses the box


@pytest.mark.parametrize("drop", [-1.0, 0.5])
def test_samples_by_importance_tile_their_intervals(drop: float) -> None:
    coarse, at = pruned(drop)
    o, d, _, _ = rays()
    weight = torch.rand(len(at), generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    quantile = (torch.arange(7, dtype=torch.float64) + 0.5).expand(len(o), 7) / 7
    fine = importance_samples(SPACE, o, d, coarse, at, weight, quantile)
    counts = coarse.first.diff()
    assert torch.equal(fine.first.diff(), torch.where(counts > 0, counts + 7, 0))  # nothing on rays where nothing is valid
    assert (counts == 0).any()
    ray, coarse_ray = sampling_ray(fine), sampling_ray(coarse)
    t = ((SPACE.world(fine.point) - o[ray]) * d[ray]).sum(dim=1)
    for r in range(len(o)):
        mine, theirs = ray == r, coarse_ray == r
        assert (t[mine].diff() >= -1e-12).all()  # in order
        assert all(float((t[mine] - each).abs().min()) < 1e-12 for each in at[theirs])  # the coarse ones are among them
        torch.testing.assert_close(fine.extent[mine].sum(), coarse.extent[theirs].sum())  # nothing twice, and no reaching across gaps
        assert (fine.extent[mine] >= 0).all()
    assert ((t >= fine.start - 1e-12) & (t <= fine.start + fine.extent + 1e-12)).all()
    torch.testing.assert_close(fine.length, fine.extent)


def test_importance_is_the_inverse_of_the_distribution() -> None:
    """One ray, intervals [0, 1) and [1, 3), a third and two thirds of the weight: against the loop."""
    origins, directions = torch.zeros(1, 3, dtype=torch.float64), torch.tensor([[1.0, 0, 0]], dtype=torch.float64)
    coarse = Samples(torch.tensor([0, 2]), *(torch.tensor(v, dtype=torch.float64) for v in ([0.0, 1.0], [1.0, 2.0], [1.0, 2.0])), torch.zeros(2, 3), 2)
    weight = torch.tensor([1.0, 2.0], dtype=torch.float64) - IMPORTANCE_FLOOR
    quantile = torch.tensor([[0.1, 0.3, 0.5, 0.9]], dtype=torch.float64)
    fine = importance_samples(SPACE, origins, directions, coarse, torch.tensor([0.95, 2.95], dtype=torch.float64), weight, quantile)
    expected = sorted([0.95, 2.95, *[3 * q if 3 * q < 1 else 1 + (3 * q - 1) for q in quantile[0].tolist()]])
    torch.testing.assert_close(SPACE.world(fine.point)[:, 0], torch.tensor(expected, dtype=torch.float64))


def same_up_to(capacity: int, padded: Samples, exact: Samples) -> None:
    """Filled from the beginning on, zeros behind; rays that end beyond the capacity are not complete."""
    kept = min(capacity, len(exact.start))
    assert torch.equal(padded.first, exact.first.clamp(max=kept))
    assert torch.equal(padded.complete, exact.first[1:] <= capacity)
    last = int(padded.first[:-1][padded.complete.logical_not()].min()) if not padded.complete.all() else kept  # a ray that is cut ends elsewhere
    for ours, theirs in zip(padded[1:5], exact[1:5], strict=True):
        assert len(ours) <= capacity
        torch.testing.assert_close(ours[:last], theirs[:last], rtol=0, atol=1e-12)
        assert not ours[kept:].any()


@pytest.mark.parametrize(("capacity", "outside"), [(30, False), (70, True), (5000, True)])
def test_a_capacity_pads_or_cuts_even_samples(outside: bool, capacity: int) -> None:
    o, d, near, far = rays()
    jitter = torch.rand(len(o), 10, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    exact, at = stratified_samples(SPACE, o, d, near, far, jitter, outside=outside)
    padded, also_at = stratified_samples(SPACE, o, d, near, far, jitter, outside=outside, capacity=capacity)
    same_up_to(capacity, padded, exact)
    assert torch.equal(also_at[: len(at)], at[:capacity])
    if outside and capacity >= 120:  # nothing is left out, so nothing is padded
        assert len(padded.start) == 120


@pytest.mark.parametrize(("padding", "capacity"), [(0, 40), (9, 90), (9, 5000)])
def test_a_capacity_pads_or_cuts_samples_by_importance(padding: int, capacity: int) -> None:
    """Of coarse samples that are padded themselves, or not; some rays have none, also the last."""
    coarse, at = pruned()
    o, d, _, _ = rays()
    generator = torch.Generator().manual_seed(4)
    weight = torch.rand(len(at) + padding, generator=generator, dtype=torch.float64)
    quantile = torch.rand(len(o), 7, generator=generator, dtype=torch.float64)
    exact = importance_samples(SPACE, o, d, coarse, at, weight[: len(at)], quantile)
    more = Samples(coarse.first, *(torch.cat([t, t.new_zeros(padding, *t.shape[1:])]) for t in coarse[1:5]), coarse.tried)
    padded = importance_samples(SPACE, o, d, more, torch.cat([at, at.new_zeros(padding)]), weight, quantile, capacity)
    assert 90 < len(exact.start) < 5000
    same_up_to(capacity, padded, exact)
    if capacity == 5000 and not padding and (coarse.first.diff() > 0).all():
        assert len(padded.start) == len(exact.start)


def test_where_samples_lie_is_differentiable_in_the_rays() -> None:
    """Points and lengths of all samplers by origin, direction, near and far, against finite differences in float64."""
    o, d, near, far = (t[:3].clone() for t in rays())
    voxels = torch.rand(6, 6, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    offset, jitter = torch.full((3,), 0.4, dtype=torch.float64), torch.full((3, 4), 0.3, dtype=torch.float64)
    quantile = torch.tensor([[0.21, 0.64]], dtype=torch.float64).expand(3, 2)

    def all_of(o: torch.Tensor, d: torch.Tensor, near: torch.Tensor, far: torch.Tensor) -> tuple[torch.Tensor, ...]:
        even, _ = stratified_samples(SPACE, o, d, near, far, jitter, outside=True)
        valid = valid_samples(SPACE, o, d, near, far, offset, 0.3, 30, voxels, 0.3)
        ray = sampling_ray(valid)
        at = valid.start + offset[ray] * valid.extent
        weight = torch.linspace(1, 2, len(at), dtype=torch.float64)
        pivotal = torch.arange(len(at)) % 2 == 0
        fine = pivotal_samples(SPACE, o, d, offset, valid, pivotal, 3)
        drawn = importance_samples(SPACE, o, d, valid, at, weight, quantile)
        return even.point, even.length, valid.point, valid.length, fine.point, fine.length, drawn.point, drawn.length

    assert torch.autograd.gradcheck(all_of, tuple(t.requires_grad_() for t in (o, d, near, far)), eps=1e-7, atol=1e-5)


@pytest.mark.parametrize(
    ("field", "strategy", "contracted"),
    [(("hash", "mlp", "nerf")[n % 3], each, n % 2 == 0) for n, each in enumerate(2 * ["uniform", "hierarchical", "valid", "efficient"])],
)
def test_every_strategy_serves_every_field(field: str, strategy: str, contracted: bool) -> None:
    m = untrained(contracted=contracted, field=field, sampling=strategy, num_importance_samples=6, num_coarse_samples=10)
    some = pixels()
    o, d, near, far, _ = some.bundle(some.choose(20, np.random.default_rng(0)))
    bundle = [torch.from_numpy(a) for a in (o, d, near, far)]
    offset, behind = torch.full((20,), 0.5), torch.ones(20, 3)
    first, again = (render_rays(m, *bundle, offset, behind, rng=np.random.default_rng(7)) for _ in range(2))
    assert torch.equal(first.fine.point, again.fine.point)
    assert torch.isfinite(first.fine_colour).all()
    assert float(first.fine_opacity.detach().max()) > 0
    loss = first.fine_colour.sum() if first.coarse_colour is None else first.fine_colour.sum() + first.coarse_colour.sum()
    loss.backward()
    grads = {name: group.gradient(name) for group in parameter_groups(m) for name in group.parameters}
    moved = {name.partition(".")[0] for name, grad in grads.items() if grad is not None and grad.abs().sum() > 0}
    assert moved >= ({"fine"} if strategy == "uniform" else {"coarse", "fine"})
    assert (len(first.coarse.start) == 0) == (strategy == "uniform")
    still, too = (render_rays(m, *bundle, offset, behind) for _ in range(2))  # renders are not random
    assert torch.equal(still.fine_colour, too.fine_colour)


def test_counts_are_those_of_the_strategies() -> None:
    """Between a stated near and far every ray has N_c samples, N_c + N_f in NeRF's fine stage and in uniform sampling."""
    from efficientnerf.model import model
    from tests.efficientnerf.balls import settings

    some = pixels()
    o, d, near, far, _ = some.bundle(some.choose(20, np.random.default_rng(0)))
    near[:], far[:] = 1.0, 5.0
    bundle = [torch.from_numpy(a) for a in (o, d, near, far)]
    found = {}
    for strategy in ("uniform", "hierarchical", "efficient"):
        made = settings(
            field="mlp", sampling=strategy, num_importance_samples=6, num_coarse_samples=10, near_plane=1.0, far_plane=5.0, exploration_fraction=0.0
        )
        m = model(SPACE, made, (1.0, 1.0, 1.0), "cpu", (1.0, 5.0))
        assert m.step == pytest.approx(0.4)
        found[strategy] = render_rays(m, *bundle, torch.full((20,), 0.5), torch.ones(20, 3))
    assert len(found["uniform"].fine.start) == len(found["hierarchical"].fine.start) == 20 * 16
    assert len(found["hierarchical"].coarse.start) == 20 * 10
    assert 0 < len(found["efficient"].coarse.start) <= 20 * math.ceil(2 * math.sqrt(3) / 0.4)  # those in the box
    with pytest.raises(ValueError, match="constant background"):
        model(ContractedSpace(BOUNDS), settings(near_plane=1.0, far_plane=5.0), None, "cpu", (1.0, 5.0))


@pytest.mark.parametrize("rule", ["momentum", "maximum"])
def test_valid_samples_are_those_that_the_voxels_would_keep(rule: str) -> None:
    """Equation 5 on a trained NeRF: density above zero, read as the voxels read it."""
    m = untrained(field="mlp", sampling="hierarchical", occupancy_rule=rule, num_importance_samples=6, num_coarse_samples=10)
    bundle = [torch.from_numpy(a) for a in pixels().bundle(np.arange(100, 140))[:4]]
    seen = render_rays(m, *bundle, torch.full((40,), 0.5), torch.ones(40, 3))
    raw = seen.coarse_raw[:, 0].detach()
    expected = int((raw > 0).sum()) if rule == "momentum" else int((torch.nn.functional.softplus(raw) > m.voxels.threshold).sum())
    assert valid_count(m, seen) == expected > 0
    assert valid_count(m, seen._replace(coarse_raw=seen.coarse_raw * 0 - 50)) == 0
    assert valid_count(untrained(), seen) == len(seen.coarse.start)
