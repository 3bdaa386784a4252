"""Gaussians rendered, and fitted to pictures, on the CPU (numba). The same pictures give the same bytes on any number of threads."""

import numpy as np

from efficientnerf.backends.numba.splats import fitting, raster
from efficientnerf.backends.numba.splats.pairs import Pairs, pairs_of
from efficientnerf.backends.numba.splats.projection import LANES, project
from efficientnerf.backends.pieces import pieces
from efficientnerf.backends.splat_layout import OPACITY, RECORD, ROTATION, SUMS, Lens, Picture, Rates, SplatState


def grouped(rows: np.ndarray, unseen: bool = True) -> np.ndarray:
    """Groups (G, width, 16) of rows (N, width) float32, the last filled with Gaussians that cannot be seen, or with zeros."""
    count, width = rows.shape
    out = np.zeros((-(-count // LANES) * LANES, width), np.float32)
    out[:count] = rows
    if unseen:
        out[count:, ROTATION], out[count:, OPACITY] = 1, -30
    return np.ascontiguousarray(out.reshape(-1, LANES, width).transpose(0, 2, 1))


def ungrouped(groups: np.ndarray, count: int) -> np.ndarray:
    """The first `count` rows of groups, see `grouped`."""
    return np.ascontiguousarray(groups.transpose(0, 2, 1)).reshape(-1, groups.shape[1])[:count]


def projected(values: np.ndarray, lens: Lens, degree: int, records: np.ndarray) -> Pairs:
    """The pairs of Gaussians in groups, whose `records` (16 G, RECORD) are written."""
    project(values, lens, degree, records)
    return pairs_of(records, lens.width, lens.height)


def splat_image(rows: np.ndarray, degree: int, lens: Lens, device: str = "cpu") -> tuple[np.ndarray, np.ndarray]:
    """Colour (H, W, 3), premultiplied, and transmittance (H, W) of Gaussians (N, 11 + 3 K), all float32."""
    values = grouped(rows)
    records = np.zeros((len(values) * LANES, RECORD), np.float32)
    pairs = projected(values, lens, degree, records)
    colour, light = np.empty((lens.height, lens.width, 3), np.float32), np.empty((lens.height, lens.width), np.float32)
    for tiles in pieces(len(pairs.begin) - 1):
        raster.render_tiles(tiles, records, pairs, colour, light)
    return colour, light


class SplatFit:
    """Steps of Gaussians towards pictures."""

    def __init__(self, rows: np.ndarray, moments: np.ndarray, degree: int, device: str = "cpu") -> None:
        """`rows` and `moments` as in SplatState."""
        self._count, self._degree = len(rows), degree
        self._values, self._moments = grouped(rows), grouped(moments, unseen=False)
        self._records = np.zeros((LANES * len(self._values), RECORD), np.float32)
        self._errors, self._sums = np.zeros(len(self._records), np.float32), np.zeros((0, SUMS), np.float32)

    def step(self, lens: Lens, picture: Picture, rates: Rates) -> None:
        """A step of all Gaussians that are in the image."""
        pairs = projected(self._values, lens, self._degree, self._records)
        if len(self._sums) < len(pairs.gaussian):
            self._sums = np.zeros((len(pairs.gaussian) * 5 // 4, SUMS), np.float32)
        lost = np.zeros(len(pairs.begin) - 1)
        for tiles in pieces(len(lost)):
            raster.fit_tiles(tiles, self._records, pairs, picture, self._sums, lost)
        fitting.step(self._values, self._moments, lens, self._degree, pairs.first, self._sums, rates, self._errors)

    def state(self) -> SplatState:
        return SplatState(ungrouped(self._values, self._count), ungrouped(self._moments, self._count), self._errors[: self._count])
