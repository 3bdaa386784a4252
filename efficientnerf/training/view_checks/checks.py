"""Training photographs whose cameras are wrong, found by the field: left out, tried with other poses, and taken back where evidence says otherwise.

At a few steps of the schedule all training photographs are compared with what the field shows (`residuals`). One that is explained far worse than its
neighbours is a suspect; it is left out only with further evidence:

    another place   a pose that is clearly elsewhere explains the photograph much better (`pose_search`)
    sparse points   those it observes lie outside its picture, or have other colours there
    no likeness     nothing of it is explained, as one picture nor inside tiles, and no sparse points confirm it
    few points      it observes few, and its errors stand out far: no other pose is found while the field shows a second copy of the scene for it

A photograph that observes as many sparse points as its neighbours, in the right colours, is no suspect. A view that is left out is held out: at the next check
the field, which has not seen it since, decides whether its own camera or one that is found then is right; only then it is trained on again.
C views of training.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from efficientnerf.geometry.cameras import Camera, project
from efficientnerf.model import Model
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.view_checks.pose_search import Search, find_pose, refine_pose
from efficientnerf.training.view_checks.residuals import (
    Cells,
    bundle_of,
    cells_of,
    local_error,
    middles,
    neighbours_of,
    photograph,
    rendered,
    shown,
    standing_out,
    view_errors,
)  # fmt: skip

# docs/experiments/wrong-cameras.md
MIN_VIEWS = 14  # that are left at least: of fewer, each shows what no other does
MAX_LEFT_OUT = 0.15  # share of the views
# Checks: from LOWEST steps on, after a share of the schedule, or at HIGHEST steps at the latest. At the last one nothing new is left out.
SHARES, LOWEST, HIGHEST = (0.1, 0.2, 0.35, 0.5), (300, 500, 700, 900), (600, 1200, 2000, 3000)
TOO_LATE = 0.6  # of the schedule
# A suspect: robust standard deviations inside tiles, and of both errors together, and times the error inside tiles of its neighbours.
SUSPECT, SUSPECT_BOTH, WORSE = 1.5, 3.0, 1.8
FAR_OUT = 2.0  # robust standard deviations of both errors: nothing is like
UNEXPLAINED = 0.8  # of the variance, likewise
FAR_WORSE = 3.5, 4.0  # robust standard deviations of both errors, and times the error inside tiles of its neighbours, where it observes few points
TYPICAL = 1.0  # inside tiles, up to which a photograph is explained by another pose as its neighbours are by theirs
BETTER = 0.7  # of its error: as small another pose has to make it
ELSEWHERE = 1.5  # cells by which another pose moves the picture
FEW_POINTS = 20  # observed by a view, of which nothing is concluded
SHARE_OF_POINTS = 0.5  # of the number that neighbours observe: fewer do not speak for a view
OUTSIDE = 0.2  # share of observed points that are not in the picture
COLOURS = 2.0  # robust standard deviations by which the points' colours are explained worse than in neighbours


@dataclass(frozen=True)
class Observations:
    """Sparse points as training views observe them: xyz and rgb (O, 3), the latter in 0-1, and the view (O,) of each observation."""

    xyz: np.ndarray
    rgb: np.ndarray
    view: np.ndarray


@dataclass
class ViewChecks:
    """The state of the training views."""

    given: tuple[Camera, ...]  # the cameras as they came
    done: np.ndarray  # (1,) checks
    left_out: np.ndarray  # (C,) bool: not trained on
    replaced: np.ndarray  # (C,) bool: `pose` is the camera's, and trained on unless left out
    pose: np.ndarray  # (C, 4, 4) the pose that was found for a view, world from camera; else the given one
    # (C, 6) of each view that was ever left out: step, error inside tiles, that of its neighbours, that with the pose that was found, by how many cells this
    # moves the picture (infinite without overlap), evidence as bits (1 another place, 2 points, 4 no likeness, 8 few points)
    evidence: np.ndarray

    @staticmethod
    def none(cameras: Sequence[Camera]) -> ViewChecks:
        """Nothing is known."""
        count = len(cameras)
        poses = np.stack([camera.world_from_camera for camera in cameras]).astype(np.float64)
        return ViewChecks(tuple(cameras), np.zeros(1, np.int64), np.zeros(count, bool), np.zeros(count, bool), poses, np.zeros((count, 6)))

    @property
    def cameras(self) -> list[Camera]:
        """Those that are trained on."""
        return [replace(c, world_from_camera=p) if r else c for c, p, r in zip(self.given, self.pose, self.replaced & ~self.left_out, strict=True)]

    @property
    def state(self) -> dict[str, np.ndarray]:
        """All that changes, by name."""
        return {name: getattr(self, name) for name in ("done", "left_out", "replaced", "pose", "evidence")}

    @property
    def changed(self) -> bool:
        """Whether training differs from that on the views as they came."""
        return bool((self.left_out | self.replaced).any())


def is_due(c: ViewChecks, number: int, fraction: float) -> bool:
    """Whether the views are to be checked after a step, at that fraction of the schedule."""
    k = int(c.done[0])
    if k >= len(SHARES) or len(c.given) <= MIN_VIEWS or number < LOWEST[k] or fraction > TOO_LATE:
        return False
    return fraction >= SHARES[k] or number >= HIGHEST[k]


def check(c: ViewChecks, m: Model, pixels: Pixels, observed: Observations | None, number: int) -> bool:
    """Check the views after a step; whether other views, or other cameras, are to be trained on from now on."""
    last = int(c.done[0]) == len(SHARES) - 1
    c.done += 1
    if last and not c.left_out.any():
        return False
    left_out, cameras = c.left_out.copy(), c.cameras
    now = _compare(c, m, pixels)
    for view in np.flatnonzero(c.left_out):
        _judge_again(c, now, int(view), pixels)
    if not last:
        _leave_out(c, now, pixels, observed, number)
    same = all(np.array_equal(a.world_from_camera, b.world_from_camera) for a, b in zip(cameras, c.cameras, strict=True))
    return not (same and np.array_equal(left_out, c.left_out))


def follow_checks(c: ViewChecks, pixels: Pixels) -> None:
    """Draw no pixels of views that are left out, and give views with replaced cameras these rays."""
    pixels.leave_out(c.left_out)
    pixels.set_cameras(c.cameras)


@dataclass(frozen=True)
class _Comparison:
    """What the field shows at a check. trusted (C,): not left out; errors (C, 2) and outlying (C, 2) by columns as one picture and inside tiles; usual (C,):
    errors of the neighbours inside tiles."""

    search: Search
    cells: Cells
    background: np.ndarray
    trusted: np.ndarray
    errors: np.ndarray
    outlying: np.ndarray
    usual: np.ndarray

    @property
    def suspects(self) -> np.ndarray:
        """(C,) bool: explained far worse than their neighbours."""
        inside = self.outlying[:, 1]
        return (inside >= SUSPECT) & (self.outlying.sum(axis=1) >= SUSPECT_BOTH) & (self.errors[:, 1] >= WORSE * self.usual)

    def with_camera(self, view: int, camera: Camera) -> tuple[float, np.ndarray]:
        """With another camera for a view: its error inside tiles, and (2,) how far both errors stand out."""
        render = self.search.render([camera], self.cells.size[view])[0]
        renders = [*self.search.renders[:view], render, *self.search.renders[view + 1 :]]
        errors = view_errors(self.cells, renders)
        cameras = [*self.search.cameras[:view], camera, *self.search.cameras[view + 1 :]]
        return float(errors[view, 1]), outlying_of(cameras, errors, self.trusted)[0][view]


def _compare(c: ViewChecks, m: Model, pixels: Pixels) -> _Comparison:
    background = np.full(3, 0.5) if m.background is None else np.array(m.background)
    grey = m.background is None and pixels.images.shape[1] == 4
    cells, cameras = cells_of(pixels, background), c.cameras
    renders = rendered(m, cameras, pixels.near, pixels.far, cells.size, grey)
    search = Search(m, cameras, renders, float(pixels.near.min()), float(pixels.far.max()), grey)
    errors, trusted = view_errors(cells, renders), ~c.left_out
    return _Comparison(search, cells, background, trusted, errors, *outlying_of(cameras, errors, trusted))


def outlying_of(cameras: Sequence[Camera], errors: np.ndarray, trusted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(C, 2) how far errors (C, 2) stand out, and (C,) what the second one usually is: see `standing_out`."""
    neighbours = neighbours_of(cameras)
    whole, (inside, usual) = (standing_out(errors[:, k], neighbours, trusted) for k in (0, 1))
    return np.stack([whole[0], inside], axis=1), usual


def _judge_again(c: ViewChecks, now: _Comparison, view: int, pixels: Pixels) -> None:
    """Train on a view again where the field, which has not seen it, explains it as it does its neighbours: by its own camera, or else by the one found."""
    if not now.suspects[view]:
        c.left_out[view] = c.replaced[view] = False
        c.pose[view] = c.given[view].world_from_camera
        return
    image, usable = photograph(pixels, view, now.background)
    if c.replaced[view]:
        camera = refine_pose(now.search, replace(c.given[view], world_from_camera=c.pose[view]), image, usable, now.cells.size[view])[0]
    else:
        camera = find_pose(now.search, view, image, usable, now.cells.size[view], now.trusted & ~now.suspects)[0]
    error, outlying = now.with_camera(view, camera)
    explained = outlying[1] < TYPICAL and outlying[0] < FAR_OUT
    if explained or c.replaced[view]:
        c.pose[view], c.evidence[view, 3] = camera.world_from_camera, error
    if explained:
        c.left_out[view], c.replaced[view] = False, True


def _leave_out(c: ViewChecks, now: _Comparison, pixels: Pixels, observed: Observations | None, number: int) -> None:
    """Leave out the suspects with further evidence against them, the worst first, as many as may be."""
    rest = min(int(MAX_LEFT_OUT * len(c.given)), len(c.given) - MIN_VIEWS) - int(c.left_out.sum())
    for_view, against, few = point_evidence(now.search.cameras, now.cells, observed, now.trusted)
    suspects = now.trusted & now.suspects & ~for_view
    order = [int(view) for view in np.argsort(-now.outlying[:, 1], kind="stable") if suspects[view]]
    believed = now.trusted & ~suspects
    for view in order[: max(0, 2 * rest)]:
        if rest <= 0:
            break
        image, usable = photograph(pixels, view, now.background)
        camera, error = find_pose(now.search, view, image, usable, now.cells.size[view], believed)
        moved = picture_moved(now.search, now.search.cameras[view], camera, now.cells.size[view])
        elsewhere = error <= BETTER * now.errors[view, 1] and moved >= ELSEWHERE
        unlike = bool(now.outlying[view].min() >= FAR_OUT and now.errors[view].min() >= UNEXPLAINED)
        far_worse = bool(now.outlying[view].min() >= FAR_WORSE[0] and now.errors[view, 1] >= FAR_WORSE[1] * now.usual[view])
        evidence = elsewhere + 2 * bool(against[view]) + 4 * unlike + 8 * (far_worse and bool(few[view]))
        if not evidence:
            continue
        c.evidence[view] = number, now.errors[view, 1], now.usual[view], error, moved, evidence
        c.left_out[view], c.replaced[view] = True, elsewhere
        c.pose[view] = camera.world_from_camera if elsewhere else c.given[view].world_from_camera
        rest -= 1


def picture_moved(s: Search, before: Camera, after: Camera, side: int) -> float:
    """By how many cells what a camera sees moves in its picture when another one takes its place: the median; infinite where it is mostly out of sight."""
    at, _ = middles(after, 3 * side)
    bundle = bundle_of(after, at, s.near, s.far)
    distance = np.minimum(shown(s.model, bundle, s.grey)[1], s.far)
    with np.errstate(invalid="ignore"):
        pixels, depth = project(before, bundle[:, :3] + distance[:, None] * bundle[:, 3:6])
    apart = np.where((depth > 0) & np.isfinite(pixels).all(axis=1), np.linalg.norm(pixels - at, axis=1), np.inf)
    return float(np.median(apart)) / side


def point_evidence(
    cameras: Sequence[Camera], cells: Cells, observed: Observations | None, trusted: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(C,) bool each: whether the sparse points that a view observes confirm its camera, whether they contradict it, and whether they are few."""
    count = len(cameras)
    nothing = np.zeros(count, bool)
    if observed is None:
        return nothing, nothing, nothing
    errors, outside, known = np.ones(count), np.zeros(count), np.zeros(count, np.int64)
    for view, camera in enumerate(cameras):
        of_view = observed.view == view
        known[view] = of_view.sum()
        if known[view] >= FEW_POINTS:
            errors[view], outside[view] = _point_errors(camera, cells, view, observed.xyz[of_view], observed.rgb[of_view])
    enough = known >= FEW_POINTS
    if enough.sum() < MIN_VIEWS:
        return nothing, nothing, nothing
    neighbours = neighbours_of(cameras)
    outlying, _ = standing_out(errors, neighbours, trusted & enough)
    usual = np.array([np.median(known[near]) for near in neighbours])
    against = enough & ((outside > OUTSIDE) | (outlying > COLOURS))
    few = known < SHARE_OF_POINTS * usual
    return enough & ~few & (outside < OUTSIDE / 2) & (outlying < TYPICAL), against, few


def _point_errors(camera: Camera, cells: Cells, view: int, xyz: np.ndarray, rgb: np.ndarray) -> tuple[float, float]:
    """Of points (N, 3): the share of their colours' variance that the picture's cells at their places do not explain, and the share outside the picture."""
    colour, weight = cells.colour[view], cells.weight[view]
    with np.errstate(invalid="ignore"):
        at, depth = project(camera, xyz)
    inside = (depth > 0) & (at >= 0).all(axis=1) & (at[:, 0] < camera.width) & (at[:, 1] < camera.height)
    if inside.sum() < FEW_POINTS // 2:
        return 1.0, float(1 - inside.mean())
    row, column = (np.minimum((at[inside, k] / cells.size[view]).astype(np.int64), weight.shape[1 - k] - 1) for k in (1, 0))
    found = colour[row, column]
    return local_error(rgb[inside][None], found[None], weight[row, column][None], len(found)), float(1 - inside.mean())
