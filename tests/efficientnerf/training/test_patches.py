"""Patches of pixels: every usable pixel as probable as any other, whatever the sizes of views."""

import numpy as np
import pytest

from efficientnerf.training.patches import PatchGrid
from tests.efficientnerf.small_views import SIZES, views


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


@pytest.mark.parametrize(("side", "share"), [(1, 0.5), (2, 0.05), (4, 0.5), (16, 0.0), (16, 1.0)])
def test_tiles_are_usable_where_some_patch_of_theirs_has_a_pixel(side: int, share: float) -> None:
    rng = np.random.default_rng(3)
    masks = [None if n == 2 and share == 0.5 else rng.random((h, w)) < share for n, (w, h) in enumerate(SIZES)]
    masks[0] = np.ones((5, 7), bool) if share == 0.05 else masks[0]
    if share == 0:
        masks[1] = np.arange(36).reshape(9, 4) == 30
    pixels = views(masks)
    grid = PatchGrid(pixels, side)
    every = grid.drawn_from(np.repeat(np.arange(len(grid)), side**2), EveryPatch(len(grid), side))  # type: ignore[arg-type]
    np.testing.assert_array_equal(np.flatnonzero(grid.usable_tiles), np.unique(every.tile))
    assert grid.mean_pixels == pytest.approx(len(every.pixels) / (side**2 * len(np.unique(every.tile))))
