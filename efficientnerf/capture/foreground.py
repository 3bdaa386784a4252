"""The foreground region of a trained scene: where its subject is, found from the points at which the rays of its photographs end.

Sparse points are not enough: plain, thin or close surfaces have none. The trained field's depths cover every pixel. They are counted in the cells of a coarse
grid; a cell is *trusted* where several views end in it and few see through it, which floaters fail. Where the view axes meet, the subject stands
before the planes that support it (floor, table, wall), connected with the middles of the photographs; it may reach out of most pictures. The
planes are clipped around it. Without such a subject (a street, a facade) the region is what is well observed.

P points, M cells, C cameras.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from efficientnerf.asset.region import inside_distance
from efficientnerf.asset.tree import Region
from efficientnerf.capture.cells import CENTRAL, CONNECTED, Cells, connected_parts, observed_cells, weight_in_middle
from efficientnerf.capture.coverage import meeting_point
from efficientnerf.capture.supports import LEVEL, Plane, find_supports, rays_that_end, with_feet
from efficientnerf.geometry.cameras import Camera

MIN_POINTS = 200
MIN_OPACITY = 0.5
MAX_CAMERAS = 64  # evenly spaced over the capture
CELLS_TO_FOCUS = 40  # along the distance from the cameras to what they look at
NEAR_QUANTILE = 0.35  # of a view's central distances: its subject, behind which there is always something
OBSERVED, REACHED = 0.6, 0.05  # views of a cell over those of the cells with most: what is well observed; what the subject may still reach into
FARTHEST, PATH_FARTHEST, LONGER = 1.6, 3.0, 1.2  # distance of a cell from its views over the usual distance, and of what is put into cells over that
# docs/experiments/foreground.md
MIN_ENDED = 0.05  # of the central rays of all, that end where several views do: of captures 0.37 to 0.99, of fog 0.003
MIN_SHARE, MIN_PART = 0.2, 0.02  # of the central rays: that a subject holds at least; that a connected part of it does
MARGIN, WIDE_MARGIN, SUPPORT_MARGIN, FADE = 0.06, 0.1, 0.25, 0.02  # of the longest side
MIN_INNER, MIN_ENDING = 3, 0.7  # views that show a cell off their border, where a part ends in view; of the cells at its ends
MIN_MIDDLING, MAX_BESIDE = 0.1, 1.8  # about a third of the way from the middle to the corner, in the mean


@dataclass(frozen=True, eq=False)
class Foreground:
    """The foreground region and what it was made of."""

    region: Region
    side: float  # of the cells
    subject: np.ndarray  # (N, 3) centres of the cells of a subject, its feet on its supports included; none where the region is all that is well observed
    planes: tuple[Plane, ...] = ()  # that support the subject: unit normals towards the cameras, and offsets


NO_POINTS = np.zeros((0, 3))


def find_subject(
    points: np.ndarray, views: np.ndarray, pixels: np.ndarray, cameras: Sequence[Camera], *, weights: np.ndarray | None = None, known: Sequence[Plane] = ()
) -> Foreground | None:
    """The foreground of a capture, in the training frame; None where the rays say too little.

    points   (P, 3) where rays of the photographs end (their median depth), training frame; not finite where a ray ends nowhere
    views    (P,) which camera each belongs to
    pixels   (P, 2) x, y in its image, from -1 to 1
    cameras  in the training frame, z up
    weights  (P,) opacity of each ray; None: 1. Rays of less than half end nowhere
    known    planes that support the subject: see `efficientnerf.capture.supports.find_supports`

    Deterministic. A few thousand rays of each photograph are enough.
    """
    views = np.asarray(views, np.int64)
    chosen = np.arange(len(cameras))[:: -(-len(cameras) // MAX_CAMERAS)] if len(cameras) else np.arange(0)
    number = np.full(len(cameras), -1)
    number[chosen] = np.arange(len(chosen))
    keep = number[views] >= 0 if len(cameras) else np.zeros(len(views), bool)
    points, views, pixels = np.array(points, np.float64)[keep], number[views[keep]], np.asarray(pixels, np.float64)[keep]
    cameras = [cameras[n] for n in chosen]
    ends = np.isfinite(points).all(axis=1)
    if weights is not None:
        ends &= np.asarray(weights)[keep] >= MIN_OPACITY
    points[~ends] = np.inf
    if ends.sum() < MIN_POINTS:
        return None
    focus, reach, converging = find_focus(points, views, pixels, cameras)
    cells = observed_cells(points, views, pixels, cameras, reach / CELLS_TO_FOCUS, LONGER * (FARTHEST if converging else PATH_FARTHEST) * reach)
    trusted = cells.trusted
    if trusted.sum() < 10 or cells.central[trusted].sum() < MIN_ENDED * weight_in_middle(pixels).sum():
        return None
    if not converging:
        return Foreground(_region_of(cells.centres[trusted & (cells.distance <= PATH_FARTHEST * reach)], cells.side), cells.side, NO_POINTS)
    share = cells.in_view / max(1.0, float(np.quantile(cells.in_view[trusted], 0.95)))
    centres = np.array([camera.centre for camera in cameras])
    ring = np.linalg.norm(centres[:, :2] - focus[:2], axis=1)
    inside = np.linalg.norm(cells.centres[:, :2] - focus[:2], axis=1) <= max(0.9 * float(np.median(ring)), 0.5 * reach)
    azimuth = np.sort(np.arctan2(*(centres - focus)[:, 1::-1].T))
    round_it = bool(np.diff(np.append(azimuth, azimuth[0] + 2 * np.pi)).max() < np.pi)  # the cameras stand on all sides: no gap of half a turn
    close = trusted & (cells.distance <= FARTHEST * reach) & (cells.nearest >= 0.1 * reach) & (inside | (not round_it))
    observed = close & (share >= OBSERVED)
    if not observed.any():
        return Foreground(_region_of(cells.centres[trusted], cells.side), cells.side, NO_POINTS)
    planes, support, hidden = find_supports(cells, observed, close, rays_that_end(points, views, pixels, cameras), centres, reach, known)
    level = any(normal[2] > 0.8 for normal, _ in planes)
    candidates = close & ~support & ~hidden & (share >= REACHED)
    subject = _subject(cells, candidates, observed)
    if not planes:  # only where the pictures are centred tells the subject from what is next to it; if that leaves little out, it is the subject's own
        central = _subject(cells, candidates & (cells.middling >= MIN_MIDDLING), observed)
        central |= _ending_in_view(cells, subject & ~central, central, cells.trusted & ~candidates)
        subject = central if _volume(cells.centres[subject]) > MAX_BESIDE * _volume(cells.centres[central]) else subject
    if cells.central[subject].sum() < MIN_SHARE * cells.central[close].sum():
        return Foreground(_region_of(cells.centres[observed], cells.side, level=level), cells.side, NO_POINTS)
    found = with_feet(cells.centres[subject], planes)
    if not planes:
        region = _region_of(found, cells.side, level=round_it, margin=WIDE_MARGIN)
    else:
        region = _ended_below(known, planes, _region_of(found, cells.side, cells.centres[support & close], level=level))
    return Foreground(region, cells.side, found, tuple(planes))


def find_focus(points: np.ndarray, views: np.ndarray, pixels: np.ndarray, cameras: Sequence[Camera]) -> tuple[np.ndarray, float, bool]:
    """The target of the middles of the photographs: a point (3,), the usual distance from the cameras, and whether it is one place for all of them.

    points that are not finite belong to rays that end nowhere.
    """
    distance = np.linalg.norm(points - np.array([camera.centre for camera in cameras])[views], axis=1)
    middle = np.isfinite(distance) & (np.linalg.norm(pixels, axis=1) <= CENTRAL)
    seen, reaches = [], []
    for number in range(len(cameras)):
        mine = np.flatnonzero(middle & (views == number))
        if len(mine) >= 3:
            reach = float(np.quantile(distance[mine], NEAR_QUANTILE))
            seen.append(np.median(points[mine[distance[mine] <= 1.2 * reach]], axis=0))
            reaches.append(reach)
    if not seen:
        finite = np.isfinite(distance)
        return np.median(points[finite], axis=0), float(np.median(distance[finite])), False
    reach = float(np.median(reaches))
    # The points that are seen lie on the surface, towards their cameras. If they move with the cameras there is no subject.
    centres = np.array([camera.centre for camera in cameras])
    focus, converging = meeting_point(cameras)
    off = np.median(np.linalg.norm(np.array(seen) - np.median(seen, axis=0), axis=1))
    if not converging:
        focus = np.median(seen, axis=0)
        converging = bool(off <= 0.35 * reach and off <= 0.5 * max(float(np.median(np.linalg.norm(centres - focus, axis=1))), 1e-9))
    return focus, reach, converging


def _subject(cells: Cells, candidates: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """(M,) bool: connected parts of the candidates that hold some of the central rays where they are well observed."""
    at = np.flatnonzero(candidates)
    out = np.zeros(len(candidates), bool)
    if not len(at):
        return out
    count, part = connected_parts(cells.centres[at], CONNECTED * cells.side)
    held = np.bincount(part, np.where(observed[at], cells.central[at], 0.0), count)
    out[at] = (held >= MIN_PART * held.sum())[part] & (held[part] > 0)
    return out


def _ending_in_view(cells: Cells, adjacent: np.ndarray, subject: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(M,) bool: connected parts of the cells next to a subject that end within the pictures, as horns do, and neither go on out of them nor in other cells."""
    at, out = np.flatnonzero(adjacent), np.zeros(len(adjacent), bool)
    if not len(at) or not subject.any():
        return out
    _, part = connected_parts(cells.centres[at], CONNECTED * cells.side)
    ends = cells.inner[at] >= MIN_INNER
    if others.any():
        ends &= cKDTree(cells.centres[others]).query(cells.centres[at])[0] > CONNECTED * cells.side
    bounds = np.stack([cells.centres[subject].min(axis=0), -cells.centres[subject].max(axis=0)])
    for number in range(part.max() + 1):
        mine = at[part == number]
        whole = True
        for sign, limit in zip((1, -1), bounds, strict=True):
            places = sign * cells.centres[mine]
            for axis in np.flatnonzero(places.min(axis=0) < limit):
                last = places[:, axis] <= places[:, axis].min() + CONNECTED * cells.side
                whole &= bool(ends[part == number][last].mean() >= MIN_ENDING)
        out[mine] = whole
    return out


def _ended_below(known: Sequence[Plane], planes: Sequence[Plane], region: Region) -> Region:
    """The region without what is far below a level one of its planes that is known: in the cells its place is known to a few of their sides alone."""
    bounds = region.bounds.copy()
    size = float((bounds[1] - bounds[0]).max())
    for normal, offset in known:
        if normal[2] > LEVEL and any(offset == other and (normal == one).all() for one, other in planes):
            lowest = (offset - np.maximum(normal[:2] * bounds[0, :2], normal[:2] * bounds[1, :2]).sum()) / normal[2]  # of its four corners
            bounds[0, 2] = max(bounds[0, 2], lowest - MARGIN * size)
    return replace(region, bounds=bounds)


def _volume(points: np.ndarray) -> float:
    """The volume of the box of points (N, 3)."""
    return float(np.ptp(points, axis=0).prod()) if len(points) else 0.0


def _region_of(found: np.ndarray, side: float, support: np.ndarray | None = None, *, level: bool = False, margin: float = MARGIN) -> Region:
    """A region round the subject's points (N, 3) and the support's points near them; `level`: it may be round in plan."""
    low, high = found.min(axis=0) - side, found.max(axis=0) + side
    size = float((high - low).max())
    room = SUPPORT_MARGIN * size
    support = np.zeros((0, 3)) if support is None else support
    support = support[((support >= low - room) & (support <= high + room)).all(axis=1)]
    margin = margin * size + side
    if level:  # the floor is clipped to a disc, or to a rounded rectangle about a long subject
        centre, half = (low + high)[:2] / 2, (high - low)[:2] / 2
        round_one = float(np.linalg.norm(found[:, :2] - centre, axis=1).max()) + side
        half = np.full(2, round_one) if round_one <= 1.3 * half.min() else half
        low, high = np.append(centre - half, low[2]), np.append(centre + half, high[2])
    if len(support):
        # A support that lies across an axis ends the region there; along the other axes it is clipped.
        thin = np.ptp(support, axis=0) < 0.25 * max(np.ptp(support, axis=0).max(), 1e-12)
        low, high = np.where(thin, np.minimum(low, support.min(axis=0)), low), np.where(thin, np.maximum(high, support.max(axis=0)), high)
    low, high = low - margin, high + margin
    fade = FADE * float((high - low).max())
    radius = float((high - low)[:2].min()) * (0.5 if level and abs((high - low)[0] - (high - low)[1]) < 1e-9 else 0.25 if level else 0.0)
    region = Region(np.stack([low, high]), radius, fade)
    while radius > 0 and inside_distance(region, found).min() < fade:  # corners of the subject
        radius *= 0.8
        region = Region(region.bounds, radius if radius > margin else 0.0, fade)
        radius = region.corner_radius
    return region
