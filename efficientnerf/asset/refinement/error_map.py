"""Patches drawn by an error map: more rays where the errors of earlier rays were large.

Müller et al. 2022 ("instant-ngp") draw training pixels so. T tiles (`efficientnerf.training.patches`), P patches, R rays.
"""

from typing import NamedTuple

import numpy as np

from efficientnerf.training.patches import Patches, PatchGrid

MAX_CELLS = 2**22
PART = 2**20  # tiles that are counted at a time
INTERVAL = 32  # steps after which the chances are set again
MEMORY = 0.5  # of the running mean, kept by each new error
MAX_ROOT = 4.0  # times the mean that the root of a cell's error counts, at most: errors that cannot be fitted should not take all rays


class Drawn(NamedTuple):
    """Patches, and the factor (P,) of each one's loss in an unbiased mean over all tiles."""

    patches: Patches
    factor: np.ndarray


def _cells(patches: PatchGrid, tiles: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns (V,) of cells of so many tiles a side."""
    return -(-patches.rows // tiles), -(-patches.columns // tiles)


def tiles_of_cell(patches: PatchGrid) -> int:
    """Tiles along the side of a cell."""
    tiles = 1
    while count_cells(patches, tiles) > MAX_CELLS:
        tiles *= 2
    return tiles


def count_cells(patches: PatchGrid, tiles: int | None = None) -> int:
    """C, of cells of so many tiles a side; None: `tiles_of_cell`."""
    rows, columns = _cells(patches, tiles_of_cell(patches) if tiles is None else tiles)
    return int((rows * columns).sum())


class ErrorMap:
    """Chances of the tiles of a grid, in cells of so many tiles a side that there are MAX_CELLS at most.

    errors  (2, C) float32, C cells: the running mean of a cell's error, negative before its first; and that by which the chances were set. With these the map
            goes on where another one stopped.
    """

    def __init__(self, patches: PatchGrid, met: np.ndarray | None = None, errors: np.ndarray | None = None, *, share: float = 0.9) -> None:
        """met: (T,) bool of the tiles that may be drawn, or None: all. ValueError where `errors` are those of another grid.

        share  of the patches that are drawn by errors, the rest from all tiles alike; below 1, for else an error of 0 would stay for ever
        """
        self.patches, self.tiles, self.share = patches, tiles_of_cell(patches), share
        self.rows, self.columns = _cells(patches, self.tiles)
        self.first = np.concatenate([[0], np.cumsum(self.rows * self.columns)]).astype(np.int64)
        cells = int(self.first[-1])
        self.errors = np.full((2, cells), -1, np.float32) if errors is None else errors
        if self.errors.shape != (2, cells) or self.errors.dtype != np.float32:
            raise ValueError(f"errors {self.errors.shape} {self.errors.dtype}: expected {(2, cells)} float32")
        usable = patches.usable_tiles
        if met is not None and usable is not None:
            met = met & usable if (met & usable).any() else usable
        self.met = self._count_met(usable if met is None else met)
        self._set_chances()

    def _count_met(self, met: np.ndarray | None) -> np.ndarray:
        """(C,) tiles of each cell that may be drawn; a part of the tiles at a time, for there may be many."""
        counts = np.zeros(len(self.errors[0]), np.int64)
        for begin in range(0, len(self.patches), PART):
            end = min(begin + PART, len(self.patches))
            tile = np.arange(begin, end) if met is None else begin + np.flatnonzero(met[begin:end])
            np.add.at(counts, self._cell(tile), 1)
        return counts

    def _cell(self, tile: np.ndarray) -> np.ndarray:
        if self.tiles == 1:
            return tile
        view, row, column = self.patches.places(tile)
        found: np.ndarray = self.first[view] + row // self.tiles * self.columns[view] + column // self.tiles
        return found

    def _set_chances(self) -> None:
        """Chances of tiles that may be drawn: `share` of them in proportion to the root of the error, of a cell without one as of the mean; the rest for all
        alike."""
        known = (self.errors[1] >= 0) & (self.met > 0)
        root = np.sqrt(np.maximum(self.errors[1], 0), dtype=np.float32)
        mean = np.average(root[known], weights=self.met[known]) if known.any() else 0.0
        chance = np.where(known, np.minimum(root, MAX_ROOT * mean), mean) if mean > 0 else np.ones(len(root))
        chance = self.share * chance + (1 - self.share) * np.average(chance, weights=self.met)
        cumulative = np.cumsum(chance * self.met, dtype=np.float64)
        self.cumulative = cumulative / cumulative[-1]
        # If all tiles were alike, each would have one chance of its number.
        self.factor = (cumulative[-1] / (chance * self.met.sum())).astype(np.float32)

    def draw(self, count: int, rng: np.random.Generator) -> Drawn:
        """Patches of about `count` pixels, at least one, with replacement; none is empty."""
        while True:
            number = max(1, round(count / self.patches.mean_pixels))
            cell = np.minimum(np.searchsorted(self.cumulative, rng.random(number), side="right"), len(self.cumulative) - 1)
            drawn = self.patches.drawn_from(self._tile(cell, rng), rng)
            if len(drawn.tile):
                return Drawn(drawn, self.factor[self._cell(drawn.tile)])

    def _tile(self, cell: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """A random tile of each cell."""
        if self.tiles == 1:
            return cell
        view = np.searchsorted(self.first, cell, side="right") - 1
        row, column = np.divmod(cell - self.first[view], self.columns[view])
        places = []
        for at, most in ((row, self.patches.rows[view]), (column, self.patches.columns[view])):
            begin = self.tiles * at
            places.append(begin + (rng.random(len(cell)) * np.minimum(self.tiles, most - begin)).astype(np.int64))
        found: np.ndarray = self.patches.first[view] + places[0] * self.patches.columns[view] + places[1]
        return found

    def set_chances(self) -> None:
        """Draw by the errors that are recorded."""
        self.errors[1] = self.errors[0]
        self._set_chances()

    def record(self, drawn: Drawn, loss: np.ndarray) -> float:
        """Take in the losses (R,) of the rays of patches; where several are in a cell the greatest counts. Returns an unbiased mean over all tiles."""
        patches = drawn.patches
        total = np.add.reduceat(loss, patches.first[:-1], dtype=np.float64)
        mean, cell = total / np.diff(patches.first), self._cell(patches.tile)
        old = self.errors[0, cell]
        new = np.where(old < 0, mean, MEMORY * old + (1 - MEMORY) * mean).astype(np.float32)
        self.errors[0, cell] = -1
        np.maximum.at(self.errors[0], cell, new)
        return float((total * drawn.factor).sum() / len(loss))
