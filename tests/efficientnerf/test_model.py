"""The model: both stages along rays, the counts of what is evaluated, sizes and states."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from efficientnerf.fields.field import BakeableField
from efficientnerf.model import HIDDEN, Model, render_rays, restore, state_of
from tests.efficientnerf.balls import pixels, untrained


class Counting(BakeableField):
    """A field that remembers where it was queried: a ball of density e^inside round the grid's centre, e^-6 elsewhere."""

    activation = "exp"
    degree = 0

    def __init__(self, inside: float = 6.0) -> None:
        super().__init__()
        self.inside = inside
        self.snapped_points: list[Tensor] = []

    def forward(self, points: Tensor) -> Tensor:
        self.snapped_points.append(points)
        inside = (points - 0.5).norm(dim=1) < 0.25
        return torch.cat([torch.where(inside, self.inside, -6.0)[:, None], torch.zeros(len(points), 3)], dim=1)


def bundle(count: int = 64) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    some = pixels()
    origins, directions, near, far, _ = some.bundle(some.choose(count, np.random.default_rng(0)))
    return *(torch.from_numpy(a) for a in (origins, directions, near, far)), torch.full((count,), 0.3)


def seen_by(m: Model, *, prune: bool = True, rays: tuple[Tensor, ...] | None = None):  # type: ignore[no-untyped-def]
    rays = rays or bundle()
    return render_rays(m, *rays, torch.ones(len(rays[0]), 3), prune=prune)  # type: ignore[misc]


def test_nothing_is_evaluated_twice_and_nothing_that_need_not_be() -> None:
    m = untrained()
    m.coarse, m.fine = Counting(), Counting()
    inside = m.voxels.values
    axis = (torch.arange(24) + 0.5) / 24 - 0.5
    away = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).norm(dim=-1)
    inside.copy_(torch.where(away < 0.3, 1e3, 0.0))
    seen = seen_by(m)
    (coarse,), (fine,) = m.coarse.snapped_points, m.fine.snapped_points
    assert len(torch.unique(coarse, dim=0)) == len(coarse) == len(seen.coarse.start)
    assert len(torch.unique(fine, dim=0)) == len(fine) == len(seen.fine.start)
    assert (coarse - 0.5).norm(dim=1).max() < 0.3 + math.sqrt(3) / 24  # valid voxels only
    assert len(coarse) < seen.coarse.tried / 2
    assert len(fine) == m.settings.samples_per_pivot * int(seen.pivotal.sum())
    assert torch.equal(seen.pivotal, seen.coarse_weight > m.settings.pivotal_threshold)
    assert 0 < int(seen.pivotal.sum()) < 0.7 * len(coarse)  # what lies behind the surface is not
    everything = seen_by(m, prune=False)
    assert len(everything.coarse.start) == everything.coarse.tried == seen.coarse.tried
    torch.testing.assert_close(everything.fine_opacity, seen.fine_opacity, rtol=0, atol=2e-2)


def test_training_explores_intervals_without_a_pivot_and_rendering_does_not() -> None:
    m = untrained(exploration_fraction=0.5)
    rays = bundle()
    behind = torch.ones(len(rays[0]), 3)
    with torch.no_grad():
        m.coarse, m.fine = Counting(1.0), Counting()
        drawn = render_rays(m, *rays, behind)
        m.fine.snapped_points.clear()
        one, same = (render_rays(m, *rays, behind, rng=np.random.default_rng(3)) for _ in range(2))
        none = render_rays(untrained(exploration_fraction=0.0), *rays, behind, rng=np.random.default_rng(3))
    assert torch.equal(one.pivotal, same.pivotal)
    assert (one.pivotal | ~drawn.pivotal).all()  # pivots stay pivots
    share = float((one.pivotal & ~drawn.pivotal).sum()) / float((~drawn.pivotal).sum())
    assert 0.4 < share < 0.6
    *looked_at, visible = m.fine.snapped_points[: len(m.fine.snapped_points) // 2]
    assert len(visible) == len(one.fine.start) < sum(map(len, looked_at)) <= m.settings.samples_per_pivot * int(one.pivotal.sum())
    assert int(none.pivotal.sum()) <= int((none.coarse_weight > m.settings.pivotal_threshold).sum())


def test_what_training_leaves_out_is_not_seen() -> None:
    m = untrained(exploration_fraction=0.0, occupancy_update_ray_fraction=0.0)
    m.coarse, m.fine = Counting(1.0), Counting()
    with torch.no_grad():
        rendered, trained = (render_rays(m, *bundle(), torch.ones(64, 3), rng=rng) for rng in (None, np.random.default_rng(0)))
    weights = rendered.fine_weight.double().split(rendered.fine.first.diff().tolist())
    left = [1 - (torch.cumsum(each, 0) - each) for each in weights]
    assert [int((each > HIDDEN).sum()) for each in left] == trained.fine.first.diff().tolist()
    assert len(trained.fine.start) < len(rendered.fine.start)
    torch.testing.assert_close(trained.fine_colour, rendered.fine_colour, rtol=0, atol=1.01 * HIDDEN)
    torch.testing.assert_close(trained.fine_opacity, rendered.fine_opacity, rtol=0, atol=1.01 * HIDDEN)


def test_states_are_restored_and_what_does_not_fit_is_named() -> None:
    m, other = untrained(seed=0), untrained(seed=5)
    other.voxels.values.uniform_(generator=torch.Generator().manual_seed(0))
    restore(m, state_of(other))
    assert all(torch.equal(a, b) for a, b in zip(state_of(m).values(), state_of(other).values(), strict=True))
    state = state_of(other)
    with pytest.raises(ValueError, match="voxels"):
        restore(m, {name: t for name, t in state.items() if name != "voxels"})
    with pytest.raises(ValueError, match="voxels"):
        restore(m, state | {"voxels": torch.zeros(2, 2, 2)})
    with pytest.raises(ValueError, match="float64"):
        restore(m, state | {"voxels": state["voxels"].double()})


def test_surroundings_have_a_colour_of_their_own_behind_all_samples() -> None:
    m = untrained(contracted=True)
    directions = torch.nn.functional.normalize(torch.randn(10, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    assert (m.behind(directions) == 0.5).all()
    with torch.no_grad():
        m.sky.sh[0] = torch.tensor([9.0, -9.0, 0.0])
    assert m.behind(directions)[:, 0].min() > 0.9 > 0.1 > m.behind(directions)[:, 1].max()
