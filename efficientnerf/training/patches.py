"""Patches of neighbouring pixels, whose rays meet the same voxels. T tiles, P patches, R pixels."""

import itertools
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
    usable_tiles     (T,) bool: tiles with a patch that has a pixel that may be used; None: all
    mean_pixels      of a patch of these that may be used
    angle            across a patch, radians, about

    A patch leaves out pixels beyond the image or masked. So every usable pixel is as probable as any other where all tiles are.
    """

    def __init__(self, pixels: Pixels, side: int) -> None:
        self.pixels, self.side = pixels, side
        self.rows, self.columns = ((sides + side - 2) // side + 1 for sides in (pixels.height, pixels.width))
        self.first = np.concatenate([[0], np.cumsum(self.rows * self.columns)]).astype(np.int64)
        self.usable_tiles: np.ndarray | None = None if pixels.usable is None else self._usable_tiles(pixels.usable)
        # Each pixel is in side^2 patches, and each tile has as many.
        self.mean_pixels = pixels.usable_count / (len(self) if self.usable_tiles is None else int(self.usable_tiles.sum()))
        left, right = (pixels.lens + np.maximum(pixels.knots // 2 - back, 0) for back in (1, 0))
        self.angle = float(side * np.linalg.norm(pixels.lookup[right] - pixels.lookup[left], axis=1).max() / pixels.stride)

    def __len__(self) -> int:
        """T."""
        return int(self.first[-1])

    def _usable_tiles(self, bits: np.ndarray) -> np.ndarray:
        found = np.ones(len(self), bool)
        for view, (begin, end) in enumerate(itertools.pairwise(self.pixels.offsets.tolist())):
            mask = np.unpackbits(bits[begin // 8 : -(-end // 8)])[begin % 8 :][: end - begin].reshape(self.pixels.height[view], self.pixels.width[view])
            if not mask.all():
                within = _any_within(_any_within(mask.astype(bool), self.side, self.rows[view]).T, self.side, self.columns[view]).T
                found[self.first[view] : self.first[view + 1]] = within.reshape(-1)
        return found

    def places(self, tile: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The view of each tile, and its row and column there."""
        view = np.searchsorted(self.first, tile, side="right") - 1
        return view, *np.divmod(tile - self.first[view], self.columns[view])

    def centres(self, tile: np.ndarray) -> np.ndarray:
        """The pixels at the middle of tiles, or where they reach beyond the image the last of a row or column."""
        view, row, column = self.places(tile)
        y, x = (np.minimum(at * self.side + self.side // 2, sides[view] - 1) for at, sides in ((row, self.pixels.height), (column, self.pixels.width)))
        return self.pixels.offsets[view] + y * self.pixels.width[view] + x

    def drawn_from(self, tile: np.ndarray, rng: np.random.Generator) -> Patches:
        """Of each tile (P,) one of its patches, at random; those without a pixel are left out, so that none is empty."""
        back = rng.integers(self.side, size=(2, len(tile)))
        view, row, column = self.places(tile)
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


def _any_within(mask: np.ndarray, side: int, count: int) -> np.ndarray:
    """(count, columns) bool: whether rows (rows, columns) that patches of a tile reach have anything: the tile's own, and `side` - 1 before."""
    padded = np.zeros((count * side, mask.shape[1]), bool)
    padded[: len(mask)] = mask
    blocks = padded.reshape(count, side, -1)
    found: np.ndarray = np.logical_or.reduce(blocks, axis=1)
    found[1:] |= np.logical_or.reduce(blocks[:-1, 1:], axis=1)
    return found
