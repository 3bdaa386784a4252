"""Patches of pixels: every usable pixel as probable as any other, whatever the sizes of views."""

from __future__ import annotations

import numpy as np
import pytest

from efficientnerf.training.patches import PatchGrid
from tests.efficientnerf.small_views import views


class EveryPatch:
    """A generator of the places of all patches of so many tiles, given side^2 times each."""

    def __init__(self, tiles: int, side: int) -> None:
        self.back = np.tile(np.stack(np.divmod(np.arange(side**2), side)), tiles)

    def integers(self, most: int, size: object) -> np.ndarray:
        return self.back


@pytest.mark.parametrize("side", [1, 2, 4, 16])
def test_every_pixel_lies_in_as_many_patches(side: int) -> None:
    grid = PatchGrid(views(), side)
    found = grid.drawn_from(np.repeat(np.arange(len(grid)), side**2), EveryPatch(len(grid), side))  # type: ignore[arg-type]
    np.testing.assert_array_equal(np.bincount(found.pixels, minlength=len(grid.pixels)), side**2)
    assert grid.angle == pytest.approx(side / 9, rel=0.15)
    assert grid.mean_pixels == pytest.approx(len(grid.pixels) / len(grid))


def test_pixels_of_a_patch_are_neighbours_in_one_view_and_masks_hold() -> None:
    keep = np.random.default_rng(0).random((9, 4)) < 0.4
    pixels = views([None, keep, np.zeros((3, 1), bool)])
    grid = PatchGrid(pixels, 3)
    rng = np.random.default_rng(1)
    found = grid.drawn_from(rng.integers(len(grid), size=round(4000 / grid.mean_pixels)), rng)
    assert abs(len(found.pixels) - 4000) < 400
    assert (np.diff(found.first) > 0).all()
    assert found.first[-1] == len(found.pixels)
    assert pixels.usable_at(found.pixels).all()
    assert set(found.pixels) == set(np.flatnonzero(pixels.usable_at(np.arange(len(pixels)))))
    for a, b in zip(found.first[:-1], found.first[1:], strict=True):
        view = pixels.view_of(found.pixels[a:b])
        assert len(set(view)) == 1
        y, x = np.divmod(found.pixels[a:b] - pixels.offsets[view], pixels.width[view])
        assert np.ptp(x) < 3
        assert np.ptp(y) < 3
