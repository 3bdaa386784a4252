"""The training data of a scene: pixels with their rays, near and far planes, and sparse depth."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.capture.plane_sweep import SweptPlane
from efficientnerf.capture.supports import Support, opaque_support, support_of_patches
from efficientnerf.geometry.cameras import rays
from efficientnerf.model import Model
from efficientnerf.training.pixels import PixelRows, Pixels
from efficientnerf.training.settings import TrainSettings
from efficientnerf.training.sky import sky_of, sky_of_colour
from efficientnerf.training.sparse_depth import SparseDepthRays
from pipeline.errors import UsageError
from stages.cores import count_cores, in_order
from stages.io import scene
from stages.io.scene import Scene, View
from stages.scratch import Warn
from stages.train.averaged import averaged_views
from stages.train.settings import UNBOUNDED, stated_planes

# A plain backdrop: how far channels may be from one colour, of what share of the pixels along the borders, of which share of the photographs.
ALIKE, PLAIN, PLAIN_VIEWS = 0.06, 0.7, 0.9  # docs/experiments/whole-scene.md
MIN_TRACK = 3  # images that a sparse point must be observed in, or as many as are trained on where these are fewer
MOST_OBSERVATIONS = 2**20  # of sparse points that are used; of more, those of points drawn at random
NEAR_THE_SCENE = 1.5  # half sides of the scene bounds, within which points may be on what the subject stands on
SUPPORT_TRIES = 4  # random pixels for each that is wanted
POINTS_AT_ONCE = 2**16  # observed by equally many, whose cameras are compared
READERS = 8  # threads that read images, at most: each holds two, and disks and memory would be the limit
CUT_SHARE = 0.25  # of a view's range that stated planes leave out, from which a warning says so: the corners of the scene bounds are mostly empty
GOLDEN = (math.sqrt(5) - 1) / 2  # multiples of it, without their integer parts, fill an interval evenly
MIN_DISTANCE = 1e-9  # the scene is 2 across: a point nearer to a camera than this has no direction


def pixels_of(folder: Path, views: tuple[View, ...], rows: PixelRows | None = None, trained: Path | None = None) -> Pixels:
    """All pixels of some views of a scene, as bytes; two images for each of `reading_threads` are held besides them.

    rows     where they are put, as many as `count_pixels` says, with as many channels as `channels_of`; None: in memory
    trained  of the stage train, where it learned the photographs' exposure: they are as if all had been exposed alike; None: as they are
    """
    read = averaged_views(folder, trained)
    kept: list[np.ndarray | None] = []

    def images() -> Iterator[np.ndarray]:
        for image, mask in in_order(read, views, reading_threads(), lambda: None):
            kept.append(None if mask is None else np.packbits(mask))  # images are taken before masks
            yield image

    masks = (None if bits is None else np.unpackbits(bits, count=view.camera.width * view.camera.height) for bits, view in zip(kept, views, strict=True))
    near, far = np.array([view.near for view in views]), np.array([view.far for view in views])
    return Pixels([view.camera for view in views], images(), masks, near, far, channels_of(folder, views), rows)


def reading_threads() -> int:
    """Threads that `pixels_of` reads images on."""
    return min(READERS, count_cores())


def count_pixels(views: tuple[View, ...]) -> int:
    """Pixels of all views."""
    return sum(view.camera.width * view.camera.height for view in views)


def channels_of(folder: Path, views: tuple[View, ...]) -> int:
    """3, or 4 where any view has alpha."""
    return 4 if any(scene.has_alpha(folder, view) for view in views) else 3


def depth_range(s: Scene, pixels: Pixels, settings: TrainSettings, warn: Warn = lambda text: None) -> tuple[float, float]:
    """Nearest and farthest of all views along their axes; where the settings state planes these, which are set for the pixels too. UsageError where the scene
    has no place for them, or they are not in order.

    warn  is called where the stated planes cut into most views' range
    """
    planes = stated_planes(settings)
    if planes is None:
        return min(view.near for view in s.views), max(view.far for view in s.views)
    if s.background is None:
        raise UsageError("train.near_plane and train.far_plane are for scenes on a constant background; this one is unbounded. Leave them auto.")
    if s.contracted:
        raise UsageError(UNBOUNDED)
    near, far = (plane * float(s.world_from_capture.scale) for plane in planes)
    compare_with_views(s, near, far, warn)
    pixels.near[:], pixels.far[:] = near, far
    return near, far


def compare_with_views(s: Scene, near: float, far: float, warn: Warn) -> None:
    """UsageError where the stated planes, in the training frame, leave out all of what the views have of the scene: the field would be empty. A warning where
    they leave out more than CUT_SHARE of it in most views."""
    first, last = np.array([(view.near, view.far) for view in s.views], np.float64).T
    scale = float(s.world_from_capture.scale)
    stated, own = (f"{a / scale:.3g} to {b / scale:.3g}" for a, b in ((near, far), (first.min(), last.max())))
    ranges = f"train.near_plane and train.far_plane are {stated} in the capture's units, and the scene is {own} from the cameras"
    inside = np.minimum(last, far) - np.maximum(first, near)
    if (inside <= 0).all():
        raise UsageError(f"{ranges}: rays would miss all of it. Leave both auto, or set planes that enclose it.")
    if np.median(inside / (last - first)) < 1 - CUT_SHARE:
        warn(f"{ranges}: rays miss a part of it. Leave both auto, or set planes that enclose it.")


def begin_sky(m: Model, pixels: Pixels) -> str | None:
    """Begin the sky of an untrained model of an unbounded scene with what the photographs show of it; what that is, in words, or None: it stays grey.

    Where they have one plain colour along their borders, as before white or at night, it is that: before a sky of another colour a plain backdrop is first
    learned as fog round each camera, which hides the subject and costs nothing: it stays. Elsewhere it is what plain regions above the horizon have.
    """
    if m.background is not None or m.space.reaches_infinity or pixels.images.shape[1] == 4:  # behind an object with alpha anything may lie
        return None
    colours, shares = pixels.border_colours(ALIKE)
    plain = shares >= PLAIN
    colour = np.median(colours[plain], axis=0) if plain.any() else np.full(3, np.nan)
    if (plain & (np.abs(colours - colour).max(axis=1) <= ALIKE)).mean() >= PLAIN_VIEWS:
        m.sky.begin_with(sky_of_colour(colour))
        return "the one plain colour along the photographs' borders"
    if (harmonics := sky_of(pixels)) is None:
        return None
    m.sky.begin_with(harmonics)
    return "what photographs show above the horizon"


def sparse_depth_of(
    folder: Path, s: Scene, seed: int = 0, sweep: Callable[[np.ndarray], Sequence[SweptPlane]] = lambda points: ()
) -> SparseDepthRays | None:
    """Rays to the sparse points that are registered in training images, from the cameras of these and from between each and the nearest of the others that see
    the point, where held-out views may lie and nothing else keeps fog away; None: there are none.

    Where the sparse points show what the subject stands on, rays of random pixels to it come with them (`efficientnerf.capture.supports.opaque_support`).
    So do rays to what `sweep` finds, which gets those near the scene (N, 3): a table has features here and none there.

    Only points that are observed in `MIN_TRACK` images or more, and only from cameras that they lie before: posed data sets name points behind a camera,
    or in it, too. Where they are observed more than `MOST_OBSERVATIONS` times, `seed` draws the points.
    """
    if not s.points:
        return None
    xyz, counts, observers = scene.read_observations(folder)
    in_training = np.array([view.split == "train" for view in s.views])
    centres = np.array([view.camera.centre for view in s.views])
    tracked = counts >= min(MIN_TRACK, int(in_training.sum()))
    if counts[tracked].sum() > MOST_OBSERVATIONS:
        order = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 3, 0])).permutation(np.flatnonzero(tracked))
        tracked[order[np.cumsum(counts[order]) > MOST_OBSERVATIONS]] = False
    used = np.repeat(tracked, counts) & in_training[observers]
    if not used.any():
        return None
    point, view = np.repeat(np.arange(len(counts)), counts)[used], observers[used]
    offset = xyz[point] - centres[view]
    distance = np.linalg.norm(offset, axis=1)
    forward = np.array([v.camera.forward for v in s.views])
    before = (offset * forward[view]).sum(1) > MIN_DISTANCE  # so is the distance; what is not a number is not before anything
    if not before.any():
        return None
    point, view, to_point, length = point[before], view[before], offset[before], distance[before]
    origins = np.concatenate([centres[view], _between(point, view, centres)])
    offset = np.concatenate([xyz[point]] * 2) - origins
    distance = np.linalg.norm(offset, axis=1)
    found = _rays(origins, offset / distance[:, None], distance, on_support=False)
    middle, reach = s.bounds.mean(axis=0), NEAR_THE_SCENE * (s.bounds[1] - s.bounds[0]).max() / 2
    near = (np.abs(xyz - middle) <= reach).all(axis=1)
    points, known = xyz[tracked & near], (centres[view], to_point / length[:, None], length)
    table = opaque_support(points, centres[in_training], *known)
    supports = [] if table is None else [table]
    for plane in sweep(points):
        support = support_of_patches((plane.normal, plane.offset), plane.xyz, points, *known)
        if support is not None:
            supports.append(support)
            offset = np.concatenate([plane.xyz - plane.cameras[:, number] for number in (0, 1)])
            distance = np.linalg.norm(offset, axis=1)
            found = _joined(found, _rays(plane.cameras.transpose(1, 0, 2).reshape(-1, 3), offset / distance[:, None], distance, on_support=False))
    return _with_supports(found, supports, scene.views_of(s, "train"), seed) if supports else found


def _with_supports(found: SparseDepthRays, supports: Sequence[Support], views: tuple[View, ...], seed: int) -> SparseDepthRays:
    """With half as many rays of random pixels to the supports, as many of each view if it shows so much of them."""
    rng = np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, 7, 0]))
    each = max(1, len(found) // (2 * len(views)))
    parts = []
    for view in views:
        pixels = rng.random((SUPPORT_TRIES * each, 2)) * (view.camera.width, view.camera.height)
        origins, directions = rays(view.camera, pixels)
        distance = np.min([support.distances(origins, directions) for support in supports], axis=0)
        meets = np.flatnonzero(np.isfinite(distance))[:each]
        parts.append((origins[meets], directions[meets], distance[meets]))
    origins, directions, distance = (np.concatenate(part) for part in zip(*parts, strict=True))
    planes = tuple((support.normal, support.offset) for support in supports)
    return replace(_joined(found, _rays(origins, directions, distance, on_support=True)), planes=planes)


def _joined(first: SparseDepthRays, second: SparseDepthRays) -> SparseDepthRays:
    arrays = ("origins", "directions", "distance", "on_support")
    joined: dict[str, Any] = {name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in arrays}
    return replace(first, **joined)


def _rays(origins: np.ndarray, directions: np.ndarray, distance: np.ndarray, *, on_support: bool) -> SparseDepthRays:
    origins, directions, distance = (np.asarray(array, np.float32) for array in (origins, directions, distance))
    return SparseDepthRays(origins, directions, distance, np.full(len(distance), on_support))


def _between(point: np.ndarray, view: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """(A, 3) for each observation of a point by a view, in the order of the points, a place on the way from its camera to the nearest other one that observes
    the same point; the camera itself where there is none. Both see the point, so that what lies between these three is most likely empty."""
    origins = centres[view]
    first = np.flatnonzero(np.diff(point, prepend=-1))
    count = np.diff(np.append(first, len(point)))
    for k in np.unique(count[count > 1]).tolist():
        alike = first[count == k]
        each = max(1, POINTS_AT_ONCE // k**2)
        for begin in range(0, len(alike), each):
            rows = alike[begin : begin + each, None] + np.arange(k)  # (n, k)
            own = centres[view[rows]]
            apart = np.linalg.norm(own[:, :, None] - own[:, None], axis=-1)
            apart[apart == 0] = np.inf
            other = np.where(np.isfinite(apart.min(axis=2)), apart.argmin(axis=2), np.arange(k))
            share = (GOLDEN * (1 + rows) % 1)[..., None]
            origins[rows] += share * (np.take_along_axis(own, other[..., None], axis=1) - own)
    return origins
