"""The plane that a subject stands on or hangs on, where a table or wall has too little texture for features: that along which photographs agree (plane
sweeping, Collins 1996).

A patch of faint grain says little; thousands of them in pairs of photographs agree on one plane. V photographs, E pairs of them, P patches of S samples.
"""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from efficientnerf.capture.supports import along, near_points
from efficientnerf.geometry.cameras import Camera, project, resized

# docs/experiments/plane-sweep.md
PIXELS = 320 * 240  # of a picture, at most
FINE, COARSE = 0.7, 4.0  # deviations in pixels of the Gaussians between which detail lies
LEAST_DETAIL = 0.6  # deviation of a patch, of 255
SIDE = 9  # pixels along a patch
NARROW, WIDE, BEST = 5.0, 35.0, 15.0  # degrees between two cameras of a pair, round the subject
PAIRS, PATCHES, FITTED, TRIED = 2, 96, 24, 6  # pairs of a photograph; patches of a pair: of all, to fit a plane, and while many are tried
AROUND, FARTHER, MORE = 2.0, 6.0, 3  # sizes of the subject, within which patches are; of a plane that is known, and how many times as many
NEAR_POINTS = 0.04  # of a picture's width: how far sparse points are from a patch
TILTS, TILT = 2, 4.0  # planes that are tried to either side of one, along x and y, and degrees from one to the next
TURNS, TURN = 10, 6.0  # directions that a wall may face, to either side of where the photographs are taken from, and degrees from one to the next
ALL_ROUND, STEEP = 90.0, 60.0  # degrees round the subject without cameras, from which on a wall is looked for; the mean view direction's from level, at most
BELOW, BEHIND, STEP = 0.3, 0.9, 0.03  # of the subject's size: how far below it, and behind it, planes are tried, and how far apart
LOWEST = 1.0  # per cent of the sparse points that may be below what is tried
TRIES = 60  # evaluations of a local search
AGREE, AGREE_ON_PLANE = 0.6, 0.15  # correlation of a patch that lies on the plane, and least mean of all patches
APART, LESS = 0.2, 0.6  # of the subject's size: how far above and below the plane patches agree at most so many times as well
NEIGHBOURS, AGREE_AROUND = 12, 0.8  # patches round one that lies on the plane, and how well they agree at least, over the upper quartile of all
SAME = 0.8  # of how well a half of the photographs agrees along the plane that it finds, least along that of the other half
SHOWN = 0.5  # of the patches, that second photographs should show
FEWEST = 100  # patches that lie on the plane
OUTSIDE = -1e6  # pixels: of what a lens does not show


@dataclass(frozen=True, eq=False)
class Picture:
    """A photograph without distortion: of a pinhole camera that sees about the same."""

    detail: np.ndarray  # (H, W) float32, what is between two Gaussians
    clear: np.ndarray  # (H, W) bool, what may show the plane
    matrix: np.ndarray  # (3, 3) float64, from directions to pixels; the first pixel's centre is at (0, 0)
    # of the camera: its axes in the world as columns, and where it stands
    rotation: np.ndarray
    centre: np.ndarray


def picture_of(grey: np.ndarray, usable: np.ndarray, camera: Camera, points: np.ndarray) -> Picture:
    """Of a photograph (H, W) uint8 and its pixels that count (H, W) bool, reduced to at most PIXELS; where sparse points (N, 3) are near it is not
    clear."""
    scale = min(1.0, (PIXELS / grey.size) ** 0.5)
    width, height = (max(2, round(length * scale)) for length in (camera.width, camera.height))
    lens = (reduced := resized(camera, width, height)).intrinsics
    matrix = np.array([[lens["fx"], 0, lens["cx"] - 0.5], [0, lens["fy"], lens["cy"] - 0.5], [0, 0, 1]])
    rotation, centre = camera.world_from_camera[:3, :3], np.asarray(camera.centre)
    pixels = np.stack([*np.meshgrid(np.arange(width), np.arange(height)), np.ones((height, width))], axis=-1).reshape(-1, 3)
    seen = project(reduced, pixels @ np.linalg.inv(matrix).T @ rotation.T + centre)[0] - 0.5
    across, down = (np.ascontiguousarray(axis.reshape(height, width)) for axis in np.nan_to_num(seen, nan=OUTSIDE).clip(OUTSIDE, -OUTSIDE).astype(np.float32).T)

    def straight(image: np.ndarray) -> np.ndarray:
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        return np.asarray(cv2.remap(small, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0))

    even = straight(grey).astype(np.float32)
    detail = cv2.GaussianBlur(even, (0, 0), FINE) - cv2.GaussianBlur(even, (0, 0), COARSE)
    clear = straight(np.where(usable, np.uint8(255), np.uint8(0))) == 255
    margin = SIDE // 2 + round(2 * COARSE)  # which detail is blurred over
    clear = cv2.erode(np.pad(clear, 1).astype(np.uint8), np.ones((2 * margin + 1,) * 2, np.uint8))[1:-1, 1:-1] > 0
    near = np.zeros((height, width), np.uint8)
    at = (points - centre) @ rotation
    at = at[at[:, 2] > 0] @ matrix.T
    x, y = np.rint(at[:, :2] / at[:, 2:]).T
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    near[y[inside].astype(int), x[inside].astype(int)] = 1
    radius = max(SIDE // 2, round(NEAR_POINTS * width))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2)
    near = cv2.morphologyEx(cv2.dilate(near, disc), cv2.MORPH_CLOSE, disc)
    return Picture(detail, clear & (near == 0), matrix, rotation, centre)


@dataclass(frozen=True, eq=False)
class SweptPlane:
    """A plane, and the patches that two photographs agree on along it."""

    normal: np.ndarray  # (3,) towards the subject
    offset: float
    xyz: np.ndarray  # (P, 3)
    cameras: np.ndarray  # (P, 2, 3) where those that show each stand


def swept_plane(pictures: Sequence[Picture], points: np.ndarray, seed: int, tick: Callable[[float], None] = lambda share: None) -> SweptPlane | None:
    """The nearly level plane, z up, below a subject of which sparse points (N, 3) are known; None where photographs agree along none.

    Two halves of the photographs find one each, and agree along each other's. It is below most points and cameras. What `tick`, which gets the share that is
    done, raises stops the search.
    """
    if (sweep := _sweep(pictures, points, np.eye(3), BELOW, seed)) is None:
        return None
    slopes = np.tan(np.radians(TILT * np.arange(-TILTS, TILTS + 1)))
    tried = [(sweep.axes, np.array([across, down])) for across in slopes for down in slopes]
    return _agreed(sweep, tried, tick)


def wall_faces(cameras: Sequence[Camera], points: np.ndarray) -> float | None:
    """About which azimuth a wall behind a subject of sparse points (N, 3) faces; None where photographs are taken from all round, or from above."""
    if len(cameras) < 3 or len(points) < 3:
        return None
    back = -np.mean([camera.forward for camera in cameras], axis=0)
    azimuth = np.sort(np.arctan2(*(np.array([camera.centre for camera in cameras]) - np.median(points, axis=0))[:, 1::-1].T))
    gap = float(np.degrees(np.diff(np.append(azimuth, azimuth[0] + 2 * np.pi)).max()))
    steep = float(np.degrees(np.arctan2(abs(back[2]), np.hypot(*back[:2]))))
    return float(np.arctan2(back[1], back[0])) if steep <= STEEP and gap >= ALL_ROUND else None


def swept_wall(
    pictures: Sequence[Picture], points: np.ndarray, faces: float, seed: int, tick: Callable[[float], None] = lambda share: None
) -> SweptPlane | None:
    """The nearly upright plane behind such a subject, which faces about an azimuth, found in the same way."""
    angles = faces + np.radians(TURN) * np.arange(-TURNS, TURNS + 1)
    axes = [np.array([[-np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0], [np.cos(angle), np.sin(angle), 0.0]]) for angle in angles]
    sweep = _sweep(pictures, points, axes[TURNS], BEHIND, seed)
    return None if sweep is None else _agreed(sweep, [(each, np.zeros(2)) for each in axes], tick)


@dataclass(frozen=True, eq=False)
class _Sweep:
    """Two halves of the photographs, to be swept by planes that are about at right angles to the last of three axes."""

    axes: np.ndarray  # (3, 3) rows
    halves: list["_Patches"]
    near: np.ndarray  # (N, 3) sparse points of the subject
    middle: np.ndarray  # (3,) of them
    size: float  # of the subject
    below: float  # of its size: how far below its lowest points planes are tried

    def turned(self, axes: np.ndarray) -> "_Sweep":
        """By planes that are about at right angles to the last of other axes."""
        return replace(self, axes=axes, halves=[half.turned(axes) for half in self.halves])

    @property
    def heights(self) -> np.ndarray:
        """Where planes are tried, along the last axis."""
        return np.arange(_lowest(self.near, self.axes) - self.below * self.size, float(self.middle @ self.axes[2]), STEP * self.size)


def _lowest(near: np.ndarray, axes: np.ndarray) -> float:
    return float(np.percentile(along(near, axes[2]), LOWEST))


def _sweep(pictures: Sequence[Picture], points: np.ndarray, axes: np.ndarray, below: float, seed: int) -> _Sweep | None:
    """None where there is too little to be compared."""
    centres = np.array([picture.centre for picture in pictures]).reshape(-1, 3)
    if len(points) < 3 or len(pictures) < 3:
        return None
    middle, near, size = near_points(points, centres)
    if not size > 0:
        return None
    rng = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 10, 0]))
    stack, lowest = _Stack(pictures), _lowest(near, axes)
    halves = [_Patches(stack, begin + 2 * _pairs(centres[begin::2] - middle), axes, middle, size, rng).chosen(lowest, AROUND, PATCHES) for begin in (0, 1)]
    return _Sweep(axes, halves, near, middle, size, below) if min(len(half.pair) for half in halves) >= FEWEST else None


def _agreed(sweep: _Sweep, tried: Sequence[tuple[np.ndarray, np.ndarray]], tick: Callable[[float], None]) -> SweptPlane | None:
    """The plane that both halves agree on, near the best of those with some axes (3, 3) and slopes (2,) along them."""
    fewer, best, begin = replace(sweep, halves=[half.fewer(TRIED, 2) for half in sweep.halves]), 0.0, None
    for done, (axes, slopes) in enumerate(tried):
        tick(done / len(tried))
        part = fewer if axes is sweep.axes else fewer.turned(axes)
        for height in part.heights:
            agreement = sum(half.agreement(np.append(slopes, height)) for half in part.halves)
            if agreement > best:
                best, begin = agreement, (axes, np.append(slopes, height))
    if begin is None:
        return None
    halves = sweep.turned(begin[0]).halves
    parts = [half.fewer(FITTED) for half in halves]
    fitted = [part.fitted(begin[1]) for part in parts]
    across = [part.agreement(tilted) / max(own, AGREE_ON_PLANE) for part, (_, own), (tilted, _) in zip(parts, fitted, reversed(fitted), strict=True)]
    if min(own for _, own in fitted) < AGREE_ON_PLANE or min(across) < SAME:
        return None
    plane, away = np.mean([tilted for tilted, _ in fitted], axis=0), np.array([0, 0, APART * sweep.size])
    if any(half.agreement(other) > LESS * half.agreement(plane) for half in halves for other in (plane - away, plane + away)):
        return None
    (normal, offset), centres = halves[0].plane(plane), halves[0].stack.centres
    if np.median(along(sweep.near, normal)) < offset or (along(centres, normal) > offset).mean() < 0.8:
        return None
    on = [half.chosen(plane[2], FARTHER, MORE * PATCHES).on(plane) for half in halves]
    xyz, shown = np.concatenate([at for at, _ in on]), np.concatenate([numbers for _, numbers in on])
    return SweptPlane(normal, offset, xyz, centres[shown]) if len(xyz) >= FEWEST else None


def _pairs(towards: np.ndarray) -> np.ndarray:
    """(E, 2) of photographs that see the subject from a few degrees apart, by where they stand from it (V, 3)."""
    away = towards / np.linalg.norm(towards, axis=1, keepdims=True).clip(min=1e-12)
    degrees = np.degrees(np.arccos(np.clip((away[:, None] * away).sum(-1), -1, 1)))
    cost = np.where((degrees >= NARROW) & (degrees <= WIDE), np.abs(degrees - BEST), np.inf)
    order = np.argsort(cost, axis=1, kind="stable")[:, :PAIRS]
    first, rank = np.nonzero(np.isfinite(np.take_along_axis(cost, order, axis=1)))
    return np.stack([first, order[first, rank]], axis=1)


class _Stack:
    """All pictures end to end."""

    def __init__(self, pictures: Sequence[Picture]) -> None:
        self.pictures, self.centres = pictures, np.array([picture.centre for picture in pictures])
        self.matrix, self.rotation = (np.array([getattr(picture, name) for picture in pictures]) for name in ("matrix", "rotation"))
        shapes = np.array([picture.detail.shape for picture in pictures])
        self.width, self.height = shapes[:, 1], shapes[:, 0]
        self.begin = np.concatenate([[0], np.cumsum(self.width * self.height)])
        self.detail = np.concatenate([picture.detail.ravel() for picture in pictures])
        self.clear = np.concatenate([picture.clear.ravel() for picture in pictures])


class _Patches:
    """Patches of the first photographs of pairs, to be found in the second ones."""

    pair: np.ndarray  # (P,) to which pair each belongs
    at: np.ndarray  # (P, 2) x, y
    own: np.ndarray  # (P, S) what the first photograph shows of each

    def __init__(self, stack: _Stack, pairs: np.ndarray, axes: np.ndarray, middle: np.ndarray, size: float, rng: np.random.Generator) -> None:
        self.stack, self.pairs, self.axes, self.middle, self.size, self.rng = stack, pairs, axes, middle, size, rng
        side = np.arange(SIDE) - SIDE // 2
        self.window = np.stack([*np.meshgrid(side, side), np.zeros((SIDE, SIDE))], axis=-1).reshape(-1, 3)
        first, second = pairs.T
        back, turned = np.linalg.inv(stack.matrix[first]), stack.matrix[second] @ stack.rotation[second].transpose(0, 2, 1)
        # of the homographies from each first photograph to its second one: without a plane, and what a plane adds (see `correlations`)
        self.far = turned @ stack.rotation[first] @ back
        self.shift = np.einsum("eij,ej->ei", turned, stack.centres[first] - stack.centres[second])
        self.towards = stack.rotation[first] @ back

    def plane(self, tilted: np.ndarray) -> tuple[np.ndarray, float]:
        """Normal and offset of a plane as slopes along the first two axes, and its height along the third at the middle."""
        normal = np.array([tilted[0], tilted[1], 1.0]) / np.sqrt(1 + tilted[0] ** 2 + tilted[1] ** 2)
        return self.axes.T @ normal, float(normal @ [*self.axes[:2] @ self.middle, tilted[2]])

    def turned(self, axes: np.ndarray) -> "_Patches":
        """The same patches, with planes along other axes."""
        part = copy(self)
        part.axes = axes
        return part

    def chosen(self, height: float, around: float, each: int) -> "_Patches":
        """With `each` random patches of each pair, that see what is at a height along the last axis, within so many sizes of the subject."""
        part, stack = copy(self), self.stack
        chosen = [self._pixels(stack.pictures[first], height, around, each) for first, _ in self.pairs]
        part.pair = np.repeat(np.arange(len(chosen)), [len(pixels) for pixels in chosen])
        part.at = np.concatenate(chosen) if chosen else np.zeros((0, 2), int)
        x, y = (part.at[:, None] + self.window[:, :2].astype(int)).transpose(2, 0, 1)
        own = self.pairs[part.pair, 0][:, None]
        part.own = _normalised(stack.detail[stack.begin[own] + y * stack.width[own] + x])
        return part

    def _pixels(self, picture: Picture, height: float, around: float, each: int) -> np.ndarray:
        """(P, 2) pixels with detail of a photograph, for `chosen`."""
        x, y, towards = _rays(picture, self.axes)
        centre = self.axes @ picture.centre
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (height - centre[2]) / towards[:, 2]
            at = centre + distance[:, None] * towards
        with np.errstate(invalid="ignore", over="ignore"):
            near = (distance > 0) & (np.hypot(*(at[:, :2] - self.axes[:2] @ self.middle).T) <= around * self.size)
        square = cv2.boxFilter(picture.detail**2, -1, (SIDE, SIDE)) - cv2.boxFilter(picture.detail, -1, (SIDE, SIDE)) ** 2
        pixels = np.flatnonzero(near & (picture.clear & (square > LEAST_DETAIL**2)).ravel())
        pixels = self.rng.choice(pixels, min(len(pixels), each), replace=False)
        return np.stack([x[pixels], y[pixels]], axis=1)

    def fewer(self, each: int, apart: int = 1) -> "_Patches":
        """Some patches of each pair, with samples so many pixels apart."""
        part = copy(self)
        keep = np.arange(len(self.pair)) - np.searchsorted(self.pair, self.pair) < each
        sparse = (self.window[:, :2] % apart == 0).all(axis=1)
        part.pair, part.at, part.window, part.own = self.pair[keep], self.at[keep], self.window[sparse], _normalised(self.own[keep][:, sparse])
        return part

    def correlations(self, tilted: np.ndarray) -> np.ndarray:
        """(P,) of each patch with what the second photograph shows of it if it lies on a plane; NaN where that is not clear."""
        (normal, offset), stack = self.plane(tilted), self.stack
        height = offset - along(stack.centres[self.pairs[:, 0]], normal)
        height[height == 0] = 1e-12
        to = self.far + self.shift[:, :, None] * np.einsum("eij,i->ej", self.towards, normal)[:, None] / height[:, None, None]
        pixels = np.concatenate([self.at, np.ones((len(self.at), 1))], axis=1)[:, None] + self.window
        other = np.einsum("pij,psj->psi", to[self.pair], pixels)
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = other[..., 0] / other[..., 2], other[..., 1] / other[..., 2]
        number = self.pairs[self.pair, 1][:, None]
        inside = ((other[..., 2] > 0) & (x >= 0) & (x < stack.width[number] - 1) & (y >= 0) & (y < stack.height[number] - 1)).all(axis=1)
        x, y, number = x[inside], y[inside], number[inside]
        left, top = x.astype(int), y.astype(int)
        at = stack.begin[number] + top * stack.width[number] + left
        right, down = (x - left).astype(np.float32), (y - top).astype(np.float32)
        upper = stack.detail[at] * (1 - right) + stack.detail[at + 1] * right
        below = at + stack.width[number]
        theirs = upper * (1 - down) + (stack.detail[below] * (1 - right) + stack.detail[below + 1] * right) * down
        usable = stack.clear[at[:, len(self.window) // 2]] & (theirs.std(axis=1) > LEAST_DETAIL)
        found = np.full(len(self.at), np.nan, np.float32)
        found[np.flatnonzero(inside)[usable]] = (self.own[inside][usable] * _normalised(theirs[usable])).sum(axis=1)
        return found

    def agreement(self, tilted: np.ndarray) -> float:
        """The mean correlation; less where few of the patches are shown."""
        found = self.correlations(tilted)
        return float(np.nansum(found) / max(np.isfinite(found).sum(), SHOWN * len(found)))

    def fitted(self, tilted: np.ndarray) -> tuple[np.ndarray, float]:
        """The plane near another along which patches agree most, and how well."""
        scale = np.array([np.radians(TILT), np.radians(TILT), STEP * self.size])
        simplex = tilted / scale + np.concatenate([np.zeros((1, 3)), 0.5 * np.eye(3)])
        found = minimize(
            lambda at: -self.agreement(at * scale), simplex[0], method="Nelder-Mead", options={"initial_simplex": simplex, "maxfev": TRIES}
        )  # fmt: skip
        return found.x * scale, -float(found.fun)

    def on(self, tilted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where patches that lie on a plane are (P, 3), and the two pictures of each (P, 2)."""
        normal, offset = self.plane(tilted)
        correlations = self.correlations(tilted)
        seen = np.flatnonzero(np.isfinite(correlations))
        correlation, pairs = correlations[seen], self.pairs[self.pair[seen]]
        towards = np.einsum("pij,pj->pi", self.towards[self.pair[seen]], np.concatenate([self.at[seen], np.ones((len(seen), 1))], axis=1))
        centres = self.stack.centres[pairs[:, 0]]
        xyz = centres + ((offset - along(centres, normal)) / along(towards, normal))[:, None] * towards
        if len(xyz) < NEIGHBOURS:
            return xyz[:0], pairs[:0]
        neighbours = cKDTree(xyz).query(xyz, k=NEIGHBOURS)[1]
        around = correlation[neighbours].mean(axis=1)
        kept = (correlation >= AGREE) & (around >= AGREE_AROUND * np.percentile(around, 75))
        for away in (-APART * self.size, APART * self.size):
            elsewhere = np.nan_to_num(self.correlations(np.array([*tilted[:2], tilted[2] + away]))[seen])
            kept &= elsewhere[neighbours].mean(axis=1) <= LESS * around
        return xyz[kept], pairs[kept]


def _rays(picture: Picture, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x, y (H W,) of all pixels, and the directions (H W, 3) that they see, along axes (3, 3)."""
    y, x = (axis.ravel() for axis in np.indices(picture.detail.shape))
    towards = np.stack([x, y, np.ones_like(x)], axis=1) @ np.linalg.inv(picture.matrix).T @ picture.rotation.T @ axes.T
    return x, y, towards


def _normalised(values: np.ndarray) -> np.ndarray:
    """Patches (P, S) of mean 0 and length 1."""
    values = values - values.mean(axis=1, keepdims=True)
    return np.asarray(values / np.linalg.norm(values, axis=1, keepdims=True).clip(min=1e-6), np.float32)
