"""The error map: tiles with larger errors are drawn more often, their mean stays unbiased, and a map goes on where another one stopped."""

import numpy as np
import pytest

from efficientnerf.asset.refinement import error_map
from efficientnerf.asset.refinement.error_map import MAX_ROOT, ErrorMap, count_cells
from efficientnerf.training.patches import PatchGrid
from tests.efficientnerf.small_views import views


def chances(drawn_by: ErrorMap) -> np.ndarray:
    return np.diff(drawn_by.cumulative, prepend=0)


@pytest.mark.parametrize("share", [0.0, 0.4, 0.9])
def test_chances_are_the_roots_of_errors_limited_and_the_mean_is_unbiased(share: float) -> None:
    grid = PatchGrid(views(), 2)
    rng = np.random.default_rng(1)
    errors = np.stack([rng.random(len(grid)), rng.random(len(grid)) ** 4]).astype(np.float32)
    errors[1, 2], errors[1, 5] = 1e4, -1  # far above the others; not known
    made = ErrorMap(grid, None, errors, share=share)
    root = np.sqrt(np.maximum(errors[1], 0))
    mean = root[errors[1] >= 0].mean()
    wanted = np.minimum(np.where(errors[1] < 0, mean, root), MAX_ROOT * mean)
    np.testing.assert_allclose(chances(made), (1 - share) / len(grid) + share * wanted / wanted.sum(), rtol=1e-5, atol=1e-12)
    values = rng.random(len(grid))
    np.testing.assert_allclose((chances(made) * made.factor * values).sum(), values.sum() / len(grid), rtol=1e-5)


@pytest.mark.parametrize("error", [0.0, 1e-30, 1e30])
@pytest.mark.parametrize("tiles", [None, 20])
def test_no_tile_with_rays_is_left_out_for_its_error(error: float, tiles: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever was recorded of it, and of the others: it is drawn again, so that its error is renewed."""
    if tiles is not None:
        monkeypatch.setattr(error_map, "MAX_CELLS", tiles)
    grid = PatchGrid(views(), 2)
    met = np.arange(len(grid)) % 7 != 0
    errors = np.full((2, count_cells(grid)), 0.3, np.float32)
    errors[1, ::2] = error
    made = ErrorMap(grid, met if tiles is None else None, errors)
    assert (chances(made) >= 0.999 * (1 - made.share) * made.met / made.met.sum()).all()
    assert (chances(made)[made.met == 0] == 0).all()
    assert chances(made).sum() == pytest.approx(1)
    values = np.random.default_rng(6).random(len(made.met))
    np.testing.assert_allclose((chances(made) * made.factor * values).sum(), (values * made.met).sum() / made.met.sum(), rtol=1e-5)
    if error == 0:
        drawn = made.draw(20_000, np.random.default_rng(7))
        made.record(drawn, np.full(len(drawn.patches.pixels), 0.3))
        made.set_chances()
        assert (made.errors[1, ::2] > 0)[(made.met > 0)[::2]].mean() > 0.95


def test_recorded_errors_are_running_means_of_which_the_greatest_counts() -> None:
    grid = PatchGrid(views(), 2)
    made = ErrorMap(grid)
    drawn = made.draw(60, np.random.default_rng(2))
    loss = np.arange(len(drawn.patches.pixels), dtype=np.float64)
    total = [loss[a:b].sum() for a, b in zip(drawn.patches.first[:-1], drawn.patches.first[1:], strict=True)]
    assert made.record(drawn, loss) == pytest.approx(loss.mean())
    made.record(drawn, 3 * loss)
    assert (made.errors[1] < 0).all()
    made.set_chances()
    for tile in set(drawn.patches.tile):
        here = drawn.patches.tile == tile
        means = np.array(total)[here] / np.diff(drawn.patches.first)[here]
        assert made.errors[0, tile] == pytest.approx((0.5 * means.max() + 0.5 * 3 * means).max(), rel=1e-6)
    np.testing.assert_array_equal(made.errors[0], made.errors[1])
    assert (made.errors[0] >= 0).sum() == len(set(drawn.patches.tile))
    assert chances(made).max() > 1.3 / len(grid)
