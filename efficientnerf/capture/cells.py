"""Cells of a coarse grid in which the rays of photographs end, with statistics of each. P points, M cells."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from efficientnerf.geometry.cameras import Camera, project

MAX_CELLS = 40_000
NEIGHBOURS = 4  # samples of a view that a cell is compared with
CENTRAL = 0.4  # of half the image: rays in its middle
CONNECTED = 2.2  # sides of a cell, up to which cells are connected
INNER = 0.9  # of half the image: not at its border


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells of the grid in which rays end."""

    side: float  # of a cell
    centres: np.ndarray  # (M, 3) mean of the points in each
    agree: np.ndarray  # (M,) views whose rays end there
    against: np.ndarray  # (M,) views that see through it
    in_view: np.ndarray  # (M,) views that have it in view, hidden or not
    distance: np.ndarray  # (M,) mean distance of the views that agree
    nearest: np.ndarray  # (M,) least distance from a camera
    central: np.ndarray  # (M,) weight of the central rays that end there
    middling: np.ndarray  # (M,) how near the middle of the pictures it is, from 0 to 1: the mean over the views that agree
    inner: np.ndarray  # (M,) views that agree and show it off their border

    @property
    def trusted(self) -> np.ndarray:
        """(M,) bool."""
        return (self.agree >= np.minimum(3, np.maximum(1, self.in_view))) & (self.agree >= self.against)


def observed_cells(points: np.ndarray, views: np.ndarray, pixels: np.ndarray, cameras: Sequence[Camera], side: float, farthest: float) -> Cells:
    """The cells, of about this side or larger, in which rays end that are no longer than `farthest`: what lies far away makes none larger."""
    centres = np.array([camera.centre for camera in cameras])
    with np.errstate(invalid="ignore"):
        ends = np.flatnonzero(np.linalg.norm(points - centres[views], axis=1) <= farthest)
    while True:
        index = np.floor(points[ends] / side)
        index = index[(np.abs(index) < 2**20).all(axis=1)]
        kept = ends[(np.abs(np.floor(points[ends] / side)) < 2**20).all(axis=1)]
        _, cell, count = np.unique(index, axis=0, return_inverse=True, return_counts=True)
        if len(count) <= MAX_CELLS:
            break
        side *= 1.4
    cell = cell.reshape(-1)
    centres = np.stack([np.bincount(cell, points[kept, axis], len(count)) for axis in range(3)], axis=1) / np.maximum(count, 1)[:, None]
    central = np.bincount(cell, weight_in_middle(pixels[kept]), len(count))
    agree, against, in_view, inner = (np.zeros(len(count), np.int64) for _ in range(4))
    total, middling, nearest = np.zeros(len(count)), np.zeros(len(count)), np.full(len(count), np.inf)
    for number, camera in enumerate(cameras):
        mine = np.flatnonzero(views == number)
        place, depth = project(camera, centres)
        place = 2 * place / (camera.width, camera.height) - 1
        with np.errstate(invalid="ignore"):
            seen = np.flatnonzero((depth > 0) & (np.abs(place) <= 1).all(axis=1))
        distance = np.linalg.norm(centres - camera.centre, axis=1)
        nearest = np.minimum(nearest, distance)
        in_view[seen] += 1
        if not len(mine) or not len(seen):
            continue
        found = cKDTree(pixels[mine]).query(place[seen], k=min(NEIGHBOURS, len(mine)))[1].reshape(len(seen), -1)
        beyond = np.linalg.norm(points[mine] - camera.centre, axis=1)[found] - distance[seen, None]
        tolerance = (1.5 * side + 0.02 * distance[seen])[:, None]
        ends_there = (np.abs(beyond) <= tolerance).any(axis=1)
        agree[seen] += ends_there
        inner[seen] += ends_there & (np.abs(place[seen]) <= INNER).all(axis=1)
        against[seen] += (beyond > tolerance).all(axis=1)
        total[seen] += np.where(ends_there, distance[seen], 0)
        middling[seen] += np.where(ends_there, weight_in_middle(place[seen]), 0)
    mean = np.maximum(agree, 1)
    return Cells(side, centres, agree, against, in_view, np.where(agree > 0, total / mean, np.inf), nearest, central, middling / mean, inner)


def weight_in_middle(pixels: np.ndarray) -> np.ndarray:
    """(N,) from 1 in the middle of a picture to next to nothing at its edge, for pixels (N, 2) from -1 to 1."""
    return np.asarray(np.exp(-((pixels / CENTRAL) ** 2).sum(axis=1)))


def connected_parts(places: np.ndarray, apart: float) -> tuple[int, np.ndarray]:
    """The number of parts of places (N, D) that are connected by steps up to `apart`, and the part (N,) of each."""
    pairs = cKDTree(places).query_pairs(apart, output_type="ndarray")
    count, part = connected_components(coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(places),) * 2), directed=False)
    return int(count), part
