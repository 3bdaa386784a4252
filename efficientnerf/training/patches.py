"""Patches of neighbouring pixels, whose rays meet the same voxels. T tiles, P patches, R pixels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from efficientnerf.training.pixels import Pixels


class Patches(NamedTuple):
    """Drawn patches: pixels (R,) of all, the first pixel of each in these (P + 1,), and its tile (P,)."""

    pixels: np.ndarray
    first: np.ndarray
    tile: np.ndarray


class PatchGrid:
    """All views in tiles of `side` pixels, by which patches are drawn: a tile, then one of the side^2 patches whose lowest corner is in it.

    tiles of view v  from first[v] on, rows[v] times columns[v]
    mean_pixels      of a patch that may be used
    angle            across a patch, radians, about

    What lies beyond the image, or is masked, is left out of a patch. So every pixel that may be used is as probable as any other where all tiles are.
    """

    def __init__(self, pixels: Pixels, side: int) -> None:
        self.pixels, self.side = pixels, side
        self.rows, self.columns = ((sides + side - 2) // side + 1 for sides in (pixels.height, pixels.width))
        self.first = np.concatenate([[0], np.cumsum(self.rows * self.columns)]).astype(np.int64)
        usable = len(pixels) if pixels.usable is None else int(np.unpackbits(pixels.usable, count=len(pixels)).sum())
        self.mean_pixels = usable / len(self)
        left, right = (pixels.lens + np.maximum(pixels.knots // 2 - back, 0) for back in (1, 0))
        self.angle = float(side * np.linalg.norm(pixels.lookup[right] - pixels.lookup[left], axis=1).max() / pixels.stride)

    def __len__(self) -> int:
        """T."""
        return int(self.first[-1])

    def centres(self, tile: np.ndarray) -> np.ndarray:
        """The pixels at the middle of tiles, or where they reach beyond the image the last of a row or column."""
        view = np.searchsorted(self.first, tile, side="right") - 1
        row, column = np.divmod(tile - self.first[view], self.columns[view])
        y, x = (np.minimum(at * self.side + self.side // 2, sides[view] - 1) for at, sides in ((row, self.pixels.height), (column, self.pixels.width)))
        return self.pixels.offsets[view] + y * self.pixels.width[view] + x

    def drawn_from(self, tile: np.ndarray, rng: np.random.Generator) -> Patches:
        """Of each tile (P,) one of its patches, at random; those without a pixel are left out, so that none is empty."""
        back = rng.integers(self.side, size=(2, len(tile)))
        view = np.searchsorted(self.first, tile, side="right") - 1
        row, column = np.divmod(tile - self.first[view], self.columns[view])
        step = np.arange(self.side)
        y = (self.side * row - back[0])[:, None, None] + step[:, None]  # (P, side, 1)
        x = (self.side * column - back[1])[:, None, None] + step  # (P, 1, side)
        width, height = self.pixels.width[view][:, None, None], self.pixels.height[view][:, None, None]
        index = self.pixels.offsets[view][:, None, None] + y * width + x  # (P, side, side)
        there = (y >= 0) & (y < height) & (x >= 0) & (x < width)
        if self.pixels.usable is not None:
            there &= self.pixels.usable_at(np.where(there, index, 0).reshape(-1)).reshape(there.shape)
        sizes = there.sum(axis=(1, 2))
        some = sizes > 0
        return Patches(index[there], np.concatenate([[0], np.cumsum(sizes[some])]).astype(np.int64), tile[some])
