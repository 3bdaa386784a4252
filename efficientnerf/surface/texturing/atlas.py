"""Texture atlases: the charts of a mesh side by side in a square, and which point of the surface each texel shows."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from efficientnerf.backends.numba.mesh.charts import lay_faces, pack, profiles
from efficientnerf.backends.pieces import pieces
from efficientnerf.surface.mesh import face_areas
from efficientnerf.surface.texturing.charts import Charts, charts_of

SMALLEST = 16  # texels along a side
FILLED = 0.7  # share of a square that packed charts fill, about
STEP = 0.97  # of the scale, until charts fit
NOTHING = 1e-3  # of the scale that the charts' area allows: gaps alone do not fit
MIN_SCALE = 0.8  # of the scale that is wanted, or that the charts' area alone allows
GAP = 4  # texels between charts, at least; 1/512 of the side in larger textures


class TooManyCharts(ValueError):
    """The largest texture does not hold the gaps between a mesh's charts."""


@dataclass(frozen=True, eq=False)
class Atlas:
    """A mesh's charts in a texture of S x S texels."""

    corners: np.ndarray  # (F, 3, 2) float64 texels of each face's corners: x to the right, y down from the upper edge
    chart: np.ndarray  # (F,) int64 number of each face's chart
    size: int  # S
    scale: float  # texels for each unit of the mesh

    @property
    def coordinates(self) -> np.ndarray:
        """(F, 3, 2) float64 as `efficientnerf.surface.mesh.Texture` has them."""
        return np.stack([self.corners[..., 0] / self.size, 1 - self.corners[..., 1] / self.size], -1)

    @cached_property
    def texels(self) -> Texels:
        """Those whose centres lie in a face, by face."""
        owner = np.full((self.size, self.size), -1, np.int32)
        corners = np.ascontiguousarray(self.corners)
        for part in pieces(len(corners), first=4096):
            lay_faces(corners, part.start, part.stop, owner)
        _give_each_a_texel(corners, owner)
        place = np.flatnonzero(owner.ravel() >= 0)
        face = owner.ravel()[place]
        order = np.argsort(face, kind="stable")
        place, face = place[order], face[order].astype(np.int64)
        begin = np.searchsorted(face, np.arange(len(self.corners) + 1))
        x, y = self.corners[face, :, 0] - (place % self.size + 0.5)[:, None], self.corners[face, :, 1] - (place // self.size + 0.5)[:, None]
        a, b = x[:, 1] * y[:, 2] - x[:, 2] * y[:, 1], x[:, 2] * y[:, 0] - x[:, 0] * y[:, 2]
        c = x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]
        share, total = np.stack([a, b, c], 1), (a + b + c)[:, None]
        share = np.clip(np.divide(share, total, out=np.full_like(share, 1 / 3), where=total != 0), 0, 1)  # a texel that was given may lie outside of its face
        return Texels(place, begin, np.asarray(share / share.sum(1, keepdims=True), np.float32))


@dataclass(frozen=True, eq=False)
class Texels:
    """Texels that show a point of the surface, face by face."""

    place: np.ndarray  # (T,) int64 row * S + column
    begin: np.ndarray  # (F + 1,) int64 first of each face
    share: np.ndarray  # (T, 3) float32 barycentric coordinates

    def values(self, at: np.ndarray, faces: np.ndarray, part: slice = slice(None)) -> np.ndarray:
        """(T, 3) what vertices have (V, 3), at texels: places, normals, colours."""
        corner = faces[self.face[part]]
        return np.asarray(sum(self.share[part, k, None] * at[corner[:, k]] for k in range(3)))

    @cached_property
    def face(self) -> np.ndarray:
        """(T,) int64."""
        return np.repeat(np.arange(len(self.begin) - 1), np.diff(self.begin))


def atlas_of(vertices: np.ndarray, faces: np.ndarray, scale: float, largest: int) -> Atlas:
    """An atlas of a mesh.

    scale    texels for each unit of the mesh that are wanted
    largest  texels along a side, at most

    The side is the smallest power of two that about holds them, or the largest; charts are as large as fit then. Raises TooManyCharts.
    """
    areas = face_areas(vertices, faces)
    area, extent = float(areas.sum()), float(np.ptp(vertices, 0).max(initial=0.0)) if len(vertices) else 0.0
    wanted = scale * np.sqrt(area / FILLED) if np.isfinite(scale) and scale > 0 else largest
    size = int(np.clip(2 ** np.ceil(np.log2(max(wanted, 1.0))), min(SMALLEST, largest), largest))
    while True:
        fitting = min(size * np.sqrt(FILLED / max(area, 1e-300)), 2 * size / max(extent, 1e-300))  # long and narrow charts have little area
        charts = charts_of(vertices, faces, 1 / fitting)
        least = MIN_SCALE * min(scale, fitting) if scale > 0 and 2 * size <= largest else 0
        at = fitting / STEP**3 * STEP
        while (placed := _packed(charts, at, size)) is None and at * STEP >= max(least, NOTHING * fitting):
            at *= STEP
        if placed is not None:
            return Atlas(placed, charts.chart, size, at)
        if 2 * size > largest:
            raise TooManyCharts(f"{charts.count} charts do not fit into {size} x {size} texels with gaps of {gap_of(size)} between them")
        size *= 2  # gaps take more space than charts


def gap_of(size: int) -> int:
    """Texels between charts, at least."""
    return max(GAP, size // 512)


def _packed(charts: Charts, scale: float, size: int) -> np.ndarray | None:
    """Corners (F, 3, 2) in texels of charts packed at a scale; None where they do not fit."""
    gap = gap_of(size) // 2
    corners = charts.corners * scale
    far = np.zeros((charts.count, 2))
    np.maximum.at(far, charts.chart, corners.max(1))
    wide = far[:, 0] > far[:, 1]  # they stand upright
    turned = wide[charts.chart][:, None]
    corners = np.where(turned[..., None], np.stack([far[charts.chart, 1][:, None] - corners[..., 1], corners[..., 0]], -1), corners)
    far = np.where(wide[:, None], far[:, ::-1], far)
    columns = np.ceil(far[:, 0]).astype(np.int64) + 2 * gap + 1
    if (columns > size).any() or (np.ceil(far[:, 1]) + 2 * gap + 1 > size).any():
        return None
    order = np.argsort(charts.chart, kind="stable")
    begin = np.searchsorted(charts.chart[order], np.arange(charts.count + 1))
    first = np.concatenate([[0], np.cumsum(columns)])
    bottom, top = np.full(first[-1], 4 * size, np.int64), np.zeros(first[-1], np.int64)
    profiles(np.ascontiguousarray(corners[order] + gap + 0.5), begin, first, gap, bottom, top)
    places = np.zeros((charts.count, 2), np.int64)
    by_height, horizon, step = np.lexsort((-columns, -np.ceil(far[:, 1]))), np.zeros(size, np.int64), max(1, size // 2048)
    for part in pieces(charts.count, first=64):
        if not pack(by_height[part], first, bottom, top, step, horizon, places):
            return None
    return np.asarray(corners + gap + 0.5 + places[charts.chart][:, None])


def _give_each_a_texel(corners: np.ndarray, owner: np.ndarray) -> None:
    """Faces without a texel's centre get the texel round their middle, if no other face has it: else a small chart had the colours of those next to it."""
    size = len(owner)
    without = np.ones(len(corners), bool)
    without[owner[owner >= 0]] = False
    faces = np.flatnonzero(without)
    column, row = np.clip(np.floor(corners[faces].mean(1)), 0, size - 1).astype(np.int64).T
    place, first = np.unique(row * size + column, return_index=True)
    empty = owner.reshape(-1)[place] < 0
    owner.reshape(-1)[place[empty]] = faces[first[empty]]
