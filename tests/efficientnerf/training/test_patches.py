"""Patches of pixels: every usable pixel as probable as any other, whatever the sizes of views; tiles drawn as probable as was said."""

from __future__ import annotations

import numpy as np
import pytest

from efficientnerf.training.patches import PatchGrid
from tests.efficientnerf.small_views import views


class EveryPatch:
    """A generator that draws all tiles, each with all of its patches, once."""

    def __init__(self, tiles: int, side: int) -> None:
        back = np.stack(np.divmod(np.arange(side**2), side))
        self.drawn = [np.repeat(np.arange(tiles), side**2), np.tile(back, tiles)]

    def integers(self, most: int, size: object) -> np.ndarray:
        return self.drawn.pop(0)


@pytest.mark.parametrize("side", [1, 2, 4, 16])
def test_every_pixel_lies_in_as_many_patches(side: int) -> None:
    grid = PatchGrid(views(), side)
    found = grid.draw(10, EveryPatch(len(grid), side))  # type: ignore[arg-type]
    np.testing.assert_array_equal(np.bincount(found.pixels, minlength=len(grid.pixels)), side**2)
    assert grid.angle == pytest.approx(side / 9, rel=0.15)
    assert grid.mean_pixels == pytest.approx(len(grid.pixels) / len(grid))


def test_pixels_of_a_patch_are_neighbours_in_one_view_and_masks_hold() -> None:
    keep = np.random.default_rng(0).random((9, 4)) < 0.4
    pixels = views([None, keep, np.zeros((3, 1), bool)])
    grid = PatchGrid(pixels, 3)
    found = grid.draw(4000, np.random.default_rng(1))
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


def test_tiles_are_drawn_as_probable_as_was_said() -> None:
    grid = PatchGrid(views(), 2)
    chances = np.zeros(len(grid))
    chances[[3, 8]] = 0.25, 0.75
    found = grid.draw(3000, np.random.default_rng(2), np.cumsum(chances))
    assert set(found.tile) == {3, 8}
    assert (found.tile == 8).mean() == pytest.approx(0.75, abs=0.05)
