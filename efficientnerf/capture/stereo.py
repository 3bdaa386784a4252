"""Dense points of photographs by multi-view stereo: depths of each photograph by PatchMatch, where another one's own depths confirm them.

Sparse points are few in the background, and a field that two or three photographs alone show there takes any shape. Stereo needs two photographs, and no
training. V photographs, S places for the sources of each, P sparse points, H x W pixels of a picture.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree

from efficientnerf.backends.numba.stereo import WORST, confirm_depths, improve_planes, quads_of
from efficientnerf.geometry.cameras import Camera, project, resized

# docs/experiments/stereo.md
PIXELS = 320 * 240  # of a picture, at most; patches of larger ones would show less
SOURCES = 5
ROUNDS = 4, 2  # of the search at half size, and at full size
GOOD = 0.5  # cost of a patch that counts, at most: 1 less the normalised cross-correlation
RETURN = 1.0  # pixels within which a pixel comes back by another photograph's depth
ANGLE, NARROWER, WIDER = 10.0, 4.0, 15.0  # degrees between two views of a point: the best, and how fast it counts less below and above
NEAREST, FARTHEST = 1.5, 1e-3  # times the greatest inverse depth of sparse points (their 98th percentile): the range that is searched
OUTSIDE = -1e6  # pixels: of what a lens does not show
FEWEST = 10  # sparse points that a photograph has to observe


@dataclass(frozen=True, eq=False)
class Picture:
    """A photograph without distortion: of a pinhole camera that sees about the same."""

    grey: np.ndarray  # (H, W) uint8
    matrix: np.ndarray  # (3, 3) float64, from directions to pixels; the first pixel's centre is at (0, 0)
    # of the camera: its axes in the world as columns, and where it stands
    rotation: np.ndarray
    centre: np.ndarray

    def halved(self) -> "Picture":
        height, width = (max(1, length // 2) for length in self.grey.shape)
        across, down = width / self.grey.shape[1], height / self.grey.shape[0]
        smaller = np.array([[across, 0, (across - 1) / 2], [0, down, (down - 1) / 2], [0, 0, 1]])
        return Picture(cv2.resize(self.grey, (width, height), interpolation=cv2.INTER_AREA), smaller @ self.matrix, self.rotation, self.centre)

    def to(self, other: "Picture") -> tuple[np.ndarray, np.ndarray]:
        """(3, 3) and (3,) float32: from pixels (x, y, 1) and inverse depth w to pixels of another picture: the first times the pixel and w times the other."""
        turn, shift = other.rotation.T @ self.rotation, other.rotation.T @ (self.centre - other.centre)
        return (other.matrix @ turn @ np.linalg.inv(self.matrix)).astype(np.float32), (other.matrix @ shift).astype(np.float32)


def undistorted(grey: np.ndarray, camera: Camera, most: int = PIXELS) -> Picture:
    """A photograph (H, W) uint8, reduced to at most so many pixels. What the pinhole camera shows beyond its borders is black."""
    scale = min(1.0, (most / grey.size) ** 0.5)
    width, height = (max(2, round(length * scale)) for length in (camera.width, camera.height))
    small, reduced = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA), resized(camera, width, height)
    lens = reduced.intrinsics
    matrix = np.array([[lens["fx"], 0, lens["cx"] - 0.5], [0, lens["fy"], lens["cy"] - 0.5], [0, 0, 1]])
    rotation = camera.world_from_camera[:3, :3]
    pixels = np.stack([*np.meshgrid(np.arange(width), np.arange(height)), np.ones((height, width))], axis=-1).reshape(-1, 3)
    seen = project(reduced, pixels @ np.linalg.inv(matrix).T @ rotation.T + camera.centre)[0] - 0.5
    seen = np.nan_to_num(seen, nan=OUTSIDE).clip(OUTSIDE, -OUTSIDE).astype(np.float32)
    across, down = (np.ascontiguousarray(axis.reshape(height, width)) for axis in seen.T)
    grey = cv2.remap(small, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    return Picture(grey, matrix, rotation, np.asarray(camera.centre))


def choose_sources(centres: np.ndarray, xyz: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """(V, S) numbers of the photographs that each is compared with, the best first, -1 where there are no more: those that share most points at good angles.

    centres  (V, 3) of the cameras
    xyz      (P, 3) sparse points
    seen     (V, P) bool, which observe them
    """
    score = np.zeros((len(centres), len(centres)))
    for number, own in enumerate(seen):
        points = np.flatnonzero(own)
        away = centres[:, None] - xyz[points]
        away /= np.linalg.norm(away, axis=-1, keepdims=True).clip(min=1e-12)
        wide = np.degrees(np.arccos(np.clip((away * away[number]).sum(-1), -1, 1))) - ANGLE
        score[number] = (np.exp(-((wide / np.where(wide < 0, NARROWER, WIDER)) ** 2) / 2) * seen[:, points]).sum(1)
        score[number, number] = 0
    order = np.argsort(-score, axis=1, kind="stable")[:, :SOURCES]
    return np.where(np.take_along_axis(score, order, axis=1) > 0, order, -1)


@dataclass(frozen=True, eq=False)
class DensePoints:
    """N pixels with a depth that other photographs confirm."""

    xyz: np.ndarray  # (N, 3) float64
    pixel: np.ndarray  # (N, 2) int64, x and y in its picture
    confirmed: np.ndarray  # (N, S) bool, by which of its sources


def dense_points(pictures: Sequence[Picture], sources: np.ndarray, xyz: np.ndarray, seen: np.ndarray, tick: Callable[[float], None]) -> Iterator[DensePoints]:
    """Of each picture in turn; of those that observe fewer than `FEWEST` sparse points there are none. `tick` gets the share that is done.

    sources, xyz, seen  as of `choose_sources`
    """
    smaller = [picture.halved() for picture in pictures]
    share = 1 / max(1, len(pictures))
    search = _Search(smaller, sources)
    planes: list[np.ndarray] = []
    for number, picture in enumerate(smaller):
        tick(0.3 * number * share)
        points = (xyz[seen[number]] - picture.centre) @ picture.rotation
        planes.append(search.planes(number, _nearest_points(picture, points), _range(points), ROUNDS[0])[0])
    search = _Search(pictures, sources)
    inverses, costs = [], []
    for number, picture in enumerate(pictures):
        tick(0.3 + 0.7 * number * share)
        points = (xyz[seen[number]] - picture.centre) @ picture.rotation
        found, cost = search.planes(number, _enlarged(planes[number], picture.grey.shape), _range(points), ROUNDS[1])
        planes[number] = np.empty((0, 0, 3), np.float32)
        inverses.append(np.where(cost <= GOOD, found[..., 0], np.float32(0)))
        costs.append(cost)
    together = np.concatenate([inverse.ravel() for inverse in inverses])
    for number, picture in enumerate(pictures):
        confirmed = search.confirmed(number, inverses[number], costs[number], together)
        y, x = np.nonzero(confirmed)
        towards = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(picture.matrix).T
        placed = towards / inverses[number][y, x, None] @ picture.rotation.T + picture.centre
        by = (confirmed[y, x, None] >> np.arange(sources.shape[1])) & 1 > 0
        yield DensePoints(placed, np.stack([x, y], axis=-1), by)


def _range(points: np.ndarray) -> tuple[np.float32, np.float32]:
    """The greatest and the least inverse depth that are searched, by a camera's sparse points in its axes; zeros: too few are before it."""
    before = points[points[:, 2] > 1e-6, 2]
    if len(before) < FEWEST:
        return np.float32(0), np.float32(0)
    greatest = float(np.percentile(1 / before, 98))
    return np.float32(NEAREST * greatest), np.float32(FARTHEST * greatest)


def _nearest_points(picture: Picture, points: np.ndarray) -> np.ndarray:
    """(H, W, 3) planes across the axis, at the depth of the sparse point that is nearest in the picture; points as of `_range`."""
    height, width = picture.grey.shape
    planes = np.zeros((height, width, 3), np.float32)
    points = points[points[:, 2] > 1e-6]
    if len(points):
        places = (points / points[:, 2:]) @ picture.matrix.T
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
        planes[..., 0] = (1 / points[cKDTree(places[:, :2]).query(pixels)[1], 2]).reshape(height, width)
    return planes


def _enlarged(planes: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The planes of a picture of half the size at the pixels of one of `shape`."""
    places, scales = [], []
    for length, own in zip(shape, planes.shape, strict=False):
        places.append((np.arange(length) + 0.5) * own / length - 0.5)
        scales.append(own / length)
    rows, columns = (np.clip(np.rint(place), 0, own - 1).astype(np.int64) for place, own in zip(places, planes.shape, strict=False))
    out = planes[rows][:, columns] * np.array([1, scales[1], scales[0]])
    down, across = (places[0] - rows)[:, None] / scales[0], (places[1] - columns)[None] / scales[1]
    out[..., 0] += out[..., 1] * across + out[..., 2] * down
    return np.ascontiguousarray(out, np.float32)


class _Search:
    """The kernels' arguments: `pictures`, with the sources of each."""

    def __init__(self, pictures: Sequence[Picture], sources: np.ndarray):
        self.pictures, self.sources = pictures, [row[row >= 0] for row in sources]
        self.quads = np.concatenate([quads_of(picture.grey).ravel() for picture in pictures])
        self.shapes = np.array([picture.grey.shape for picture in pictures], np.int64).reshape(-1, 2)
        self.starts = np.append(0, np.cumsum(self.shapes.prod(axis=1)))[:-1]

    def _maps(self, number: int, back: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """(S, 3, 3), (S, 3) from a picture to its sources, or back."""
        own, others = self.pictures[number], [self.pictures[source] for source in self.sources[number]]
        each = [other.to(own) if back else own.to(other) for other in others]
        return np.array([turn for turn, _ in each], np.float32).reshape(-1, 3, 3), np.array([shift for _, shift in each], np.float32).reshape(-1, 3)

    def planes(self, number: int, guess: np.ndarray, limits: tuple[np.float32, np.float32], rounds: int) -> tuple[np.ndarray, np.ndarray]:
        """Planes (H, W, 3) of a picture and their costs (H, W); `guess` becomes them."""
        picture, chosen = self.pictures[number], self.sources[number]
        cost = np.full(guess.shape[:2], WORST, np.float32)
        nearest, farthest = limits
        if nearest > 0 and len(chosen):
            others = *self._maps(number), self.quads, self.starts[chosen], self.shapes[chosen]
            grey, focal = picture.grey.astype(np.float32), np.float32(picture.matrix[0, 0])
            for turn in range(rounds):
                improve_planes(grey, nearest, farthest, focal, 16 * number + turn, *others, guess, cost)
        return guess, cost

    def confirmed(self, number: int, inverse: np.ndarray, cost: np.ndarray, inverses: np.ndarray) -> Any:
        """(H, W) int32: bits of the sources whose own depths confirm those of a picture."""
        chosen, out = self.sources[number], np.zeros(inverse.shape, np.int32)
        if len(chosen):
            others = *self._maps(number), *self._maps(number, back=True), inverses, self.starts[chosen], self.shapes[chosen]
            confirm_depths(inverse, cost, np.float32(GOOD), np.float32(RETURN), *others, out)
        return out
