"""Planes that support a subject: the floor or table that it stands on, the wall behind it.

A support hides what is behind it, the subject stands before it, not next to it, and it goes on round the subject. Ears, fins or a chest in one plane do not:
rays pass between and past them, and the head lies next to the plane of the chest.

M cells, R rays, C cameras.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, Delaunay, QhullError, cKDTree

from efficientnerf.capture.cells import CONNECTED, Cells, connected_parts
from efficientnerf.geometry.cameras import Camera
from efficientnerf.geometry.cameras import rays as camera_rays

# docs/experiments/foreground.md
TRIES, MAX_PLANES, MAX_SUPPORTS = 400, 6, 3
MIN_SUPPORT, MAX_BEHIND = 0.08, 0.125  # of the observed cells, that a plane holds; of the central rays that end before it, that end behind it: supports hide
MIN_CONNECTED = 0.25  # of the cells of a plane's largest connected part, that others have which count
MAX_THROUGH = 0.12  # of the rays that meet a plane within its outline, that go on
MAX_PAST, MAX_PAST_LEVEL = 0.15, 0.7  # the rays that go on past the edge of a plane, of those that end on it; of a floor or table, which may end in view
OUTLINE_MARGIN = 1.3  # times the outline: what is round a wall
MIN_UNDER = 0.5  # of what the middles of the photographs show before a plane, that stands on it
LEVEL = 0.995  # least height of the normal of a floor or table
FARTHEST = 1.6  # distance at which rays meet a plane over the usual distance
FLAT, MIN_ON_LEVEL, MIN_BROAD = 0.01, 0.1, 0.15  # of what is near: how far points of a level plane are off it; their share; their extent across it
MAX_POINTS = 4000  # that a level plane is looked for in
# Of a support that rays do not pass: points on it at least; sine from which rays meet it; of the rays to sparse points that meet it, those that go on, and by
# how much of the distance; of the extent of the points, round such a ray. docs/experiments/losses.md
MIN_ON_SUPPORT, GRAZING, MAX_SEEN_THROUGH, SLACK, HOLE = 30, 0.1, 0.05, 0.03, 0.05
# Of the subject's size: a wide gap between patches; how far from its middle they may be hidden by it; how large a gap may be that patches enclose
GAP, UNDER, ENCLOSED = 0.3, 0.75, 2.0
MAX_FOOT_HEIGHT = 0.3  # of the subject's size, that a part of it stands above a support at most

Plane = tuple[np.ndarray, float]


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays of photographs and where they end."""

    # origins, directions: (R, 3), directions of unit length
    origins: np.ndarray
    directions: np.ndarray
    ends: np.ndarray  # (R,) distance at which each ends; infinite where it ends nowhere


def rays_that_end(points: np.ndarray, views: np.ndarray, pixels: np.ndarray, cameras: Sequence[Camera]) -> Rays:
    """The rays of pixels (R, 2), from -1 to 1, of views (R,), which end at points (R, 3); not finite where a ray ends nowhere."""
    origins, directions = np.zeros(points.shape), np.zeros(points.shape)
    for number, camera in enumerate(cameras):
        mine = np.flatnonzero(views == number)
        origins[mine], directions[mine] = camera_rays(camera, (pixels[mine] + 1) / 2 * (camera.width, camera.height))
    with np.errstate(invalid="ignore"):
        distance = np.linalg.norm(points - origins, axis=1)
    return Rays(origins, directions, np.where(np.isfinite(distance), distance, np.inf))


def find_supports(
    cells: Cells, observed: np.ndarray, close: np.ndarray, rays: Rays, cameras: np.ndarray, reach: float, known: Sequence[Plane] = ()
) -> tuple[list[Plane], np.ndarray, np.ndarray]:
    """The planes that support the subject, unit normals towards the cameras and offsets, the cells (M,) on them, and the cells behind one.

    A plane supports where it holds many cells, the cameras (C, 3) are on one side of it, and so is most of the rest that the photographs' middles show.

    known  those that photographs or sparse points show to support it: what rays do at their edges, where nothing else keeps fog away, does not refute them
    """
    tolerance = max(1.5 * cells.side, 0.03 * reach)
    support, hidden = np.zeros(len(observed), bool), np.zeros(len(observed), bool)
    planes: list[Plane] = []
    left = observed.copy()
    for number in range(len(known) + MAX_PLANES):
        is_known = number < len(known)
        found = known[number] if is_known else _plane(cells.centres[left], tolerance)
        if found is None or len(planes) == MAX_SUPPORTS:
            break
        normal, offset = found
        if np.median(cameras @ normal - offset) < 0:
            normal, offset = -normal, -offset
        height = along(cells.centres, normal) - offset
        on = left & (np.abs(height) <= tolerance)
        if on.sum() < MIN_SUPPORT * observed.sum():
            if is_known:
                continue
            break
        before, behind = (float(cells.central[close & part].sum()) for part in (height > tolerance, height < -tolerance))
        refuted = (cameras @ normal > offset + tolerance).mean() < 0.8 or behind > MAX_BEHIND * before
        if is_known and refuted:
            continue
        left &= ~on
        if refuted or not (is_known or _supports((normal, offset), cells, on, close & (height > tolerance), rays, tolerance, reach)):
            continue
        support |= np.abs(height) <= tolerance
        hidden |= height < -tolerance
        planes.append((normal, offset))
    return planes, support, hidden & ~support


def _supports(plane: Plane, cells: Cells, on: np.ndarray, before: np.ndarray, rays: Rays, tolerance: float, reach: float) -> bool:
    """Whether a plane hides what is behind the cells (M,) on it, goes on round them, and is under what is before it."""
    normal, offset = plane
    across = _axes_across(normal)
    outline = _outline(cells.centres[on] @ across.T, CONNECTED * cells.side)
    if outline is None:
        return False
    apart = _outline_distance(outline, cells.centres[before] @ across.T)
    under = float(cells.central[before][apart <= 1.1].sum())
    toward = -along(rays.directions, normal)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (along(rays.origins, normal) - offset) / toward
        meets = (toward > 0.05) & (distance > 0) & (distance <= FARTHEST * reach) & ((rays.ends - distance) * toward > -tolerance)
    at = np.flatnonzero(meets)
    apart = _outline_distance(outline, (rays.origins[at] + distance[at, None] * rays.directions[at]) @ across.T)
    goes_on = (rays.ends[at] - distance[at]) * toward[at] > tolerance + 0.02 * distance[at]
    within, past = apart <= 1, (apart > 1) & (apart <= OUTLINE_MARGIN)
    on_it = int((within & ~goes_on).sum())
    if under < MIN_UNDER * float(cells.central[before].sum()) or (within & goes_on).sum() > MAX_THROUGH * within.sum():
        return False
    return bool((past & goes_on).sum() <= (MAX_PAST_LEVEL if abs(normal[2]) > LEVEL else MAX_PAST) * on_it)


def level_plane(points: np.ndarray, cameras: np.ndarray, up: np.ndarray, tilt: float = 30.0) -> Plane | None:
    """The floor or table of most of points (N, 3), within `tilt` degrees of level, below most cameras (C, 3), its normal upwards; None where there is none.

    Far points do not count: what is near are those that are nearer to the middle one than the usual camera is.
    """
    if len(points) < 3:
        return None
    _, near, size = near_points(points, cameras)
    found = _plane(near[:: max(1, len(near) // MAX_POINTS)], FLAT * size, up, float(np.cos(np.radians(tilt))))
    if found is None:
        return None
    normal, offset = found if found[0] @ up > 0 else (-found[0], -found[1])
    on = near[np.abs(along(near, normal) - offset) <= FLAT * size]
    flat = on @ _axes_across(normal).T
    broad = len(on) >= MIN_ON_LEVEL * len(near) and np.sqrt(np.linalg.eigvalsh(np.cov(flat.T))[0]) >= MIN_BROAD * size
    return (normal, offset) if broad and (along(cameras, normal) > offset).mean() >= 0.8 and normal @ up > np.cos(np.radians(tilt)) else None


def near_points(points: np.ndarray, cameras: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Of points (N, 3) the middle one (3,), those that are nearer to it than the usual camera (C, 3) is, and about how large what these show is."""
    middle = np.median(points, axis=0)
    near = points[np.linalg.norm(points - middle, axis=1) <= float(np.median(np.linalg.norm(cameras - middle, axis=1)))]
    return middle, near, 2 * float(np.median(np.linalg.norm(near - middle, axis=1))) if len(near) else 0.0


@dataclass(frozen=True, eq=False)
class Support:
    """The floor or table that a subject stands on, or the wall behind it, as far as points show it: a plane within the hull of those on it, seen from where the
    subject is, but for where others are seen through it. Places on it are of `_places`."""

    normal: np.ndarray  # (3,) towards the subject
    offset: float
    outline: Delaunay  # of the places of points on it
    holes: np.ndarray  # (H, 2) places of points behind that are seen through it, and of where
    around: float = 0.0  # distance from these at which it is not known to be opaque
    solid: np.ndarray | None = None  # (T,) bool, triangles of the outline that are part of it; None: all

    def distances(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """(R,) along rays (R, 3), to where they meet it from before; infinite where they do not."""
        toward = -along(directions, self.normal)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            distance = (along(origins, self.normal) - self.offset) / toward
        meets = np.flatnonzero((toward > GRAZING) & (distance > 0))
        at = _places(self.normal, origins[meets] + distance[meets, None] * directions[meets])
        triangle = self.outline.find_simplex(at)
        inside = triangle >= 0 if self.solid is None else (triangle >= 0) & self.solid[triangle]
        if len(self.holes) and inside.any():
            inside[inside] = cKDTree(self.holes).query(at[inside])[0] > self.around
        out = np.full(len(origins), np.inf)
        out[meets[inside]] = distance[meets[inside]]
        return out


def opaque_support(points: np.ndarray, cameras: np.ndarray, origins: np.ndarray, directions: np.ndarray, lengths: np.ndarray) -> Support | None:
    """The broadest level plane of points (N, 3), z up, below most cameras (C, 3); None where there is none, or where it is not opaque: rays (R, 3) to sparse
    points at `lengths` (R,) go on through it."""
    if len(points) < MIN_ON_SUPPORT:
        return None
    size = _size(points)
    broadest: tuple[float, Support] | None = None
    for _ in range(MAX_SUPPORTS + 1):
        if (plane := level_plane(points, cameras, np.array([0.0, 0.0, 1.0]))) is None:
            break
        height = np.abs(along(points, plane[0]) - plane[1])
        on, points = points[height <= FLAT * size], points[height > 2 * FLAT * size]
        if len(on) < MIN_ON_SUPPORT:
            continue
        found = _spanned(plane, on)
        area = float(ConvexHull(found.outline.points).volume)
        if broadest is None or area > broadest[0]:
            broadest = area, found
    return None if broadest is None else _unless_seen_through(broadest[1], size, origins, directions, lengths)


def support_of_patches(
    plane: Plane, patches: np.ndarray, points: np.ndarray, origins: np.ndarray, directions: np.ndarray, lengths: np.ndarray
) -> Support | None:
    """A plane as far as patches (N, 3) and sparse points on it reach, of a subject of sparse points (M, 3); None where rays (R, 3) to such points at `lengths`
    (R,) go on through it.

    A wide gap between patches is part of it near the subject, and where it is enclosed, if no such ray goes on through it: a table has an edge.
    """
    try:
        _spanned(plane, patches)
    except QhullError:  # they lie on a line
        return None
    size = _size(points)
    whole = _spanned(plane, np.concatenate([patches, points[np.abs(along(points, plane[0]) - plane[1]) <= FLAT * size]]))
    corners = whole.outline.points[whole.outline.simplices]
    wide = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1) > GAP * size
    solid = ~wide | (np.linalg.norm(corners.mean(axis=1) - np.median(_places(whole.normal, points), axis=0), axis=1) <= UNDER * size)
    distance = whole.distances(origins, directions)
    goes_on = _that_go_on(distance, lengths, size)
    crossed = whole.outline.find_simplex(_places(whole.normal, origins[goes_on] + distance[goes_on, None] * directions[goes_on]))
    solid[crossed] &= ~wide[crossed]
    for gap in _enclosed(whole.outline, wide):
        solid[gap] |= np.ptp(corners[gap], axis=(0, 1)).max() <= ENCLOSED * size and not np.isin(gap, crossed).any()
    return _unless_seen_through(replace(whole, solid=solid), size, origins, directions, lengths)


def _enclosed(outline: Delaunay, wide: np.ndarray) -> Iterator[np.ndarray]:
    """The triangles of each connected part of those that are wide (T,), of parts that do not reach the border."""
    if not len(at := np.flatnonzero(wide)):
        return
    number = np.full(len(wide) + 1, -1)  # the last one: beyond the border
    number[at] = np.arange(len(at))
    to = number[outline.neighbors[at]]
    rows, sides = np.nonzero(to >= 0)
    _, part = connected_components(coo_array((np.ones(len(rows)), (rows, to[rows, sides])), shape=(len(at),) * 2), directed=False)
    open_parts = np.unique(part[(outline.neighbors[at] < 0).any(axis=1)])
    for each in np.setdiff1d(part, open_parts):
        yield at[part == each]


def _spanned(plane: Plane, on: np.ndarray) -> Support:
    """A plane within the hull of points (N, 3) on it. Raises QhullError where they lie on a line."""
    return Support(*plane, Delaunay(_places(plane[0], on)), np.zeros((0, 2)))


def _places(normal: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, 2) where points (N, 3) are along two axes across a normal."""
    return np.stack([along(points, axis) for axis in _axes_across(normal)], axis=1)


def _that_go_on(distance: np.ndarray, lengths: np.ndarray, size: float) -> np.ndarray:
    """Of rays that meet a support at distances (R,), infinite where they do not, the numbers of those that end behind it."""
    meets = np.flatnonzero(np.isfinite(distance))
    return np.asarray(meets[lengths[meets] > distance[meets] * (1 + SLACK) + FLAT * size])


def _unless_seen_through(support: Support, size: float, origins: np.ndarray, directions: np.ndarray, lengths: np.ndarray) -> Support | None:
    """A support with holes where some rays (R, 3) to sparse points at `lengths` (R,) go on through it; None where many do."""
    distance = support.distances(origins, directions)
    goes_on = _that_go_on(distance, lengths, size)
    if len(goes_on) > MAX_SEEN_THROUGH * np.isfinite(distance).sum():
        return None
    ways = [_places(support.normal, origins[goes_on] + to[goes_on, None] * directions[goes_on]) for to in (distance, lengths)]
    return replace(support, holes=np.concatenate(ways), around=HOLE * size)


def _size(points: np.ndarray) -> float:
    """About how large a subject of sparse points (N, 3) is."""
    return 2 * float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))


def _axes_across(normal: np.ndarray) -> np.ndarray:
    """(2, 3) two unit vectors at right angles to a unit normal and to each other."""
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])


Outline = tuple[np.ndarray, np.ndarray]


def _outline(places: np.ndarray, apart: float) -> Outline | None:
    """The convex hull of the largest connected parts of places (N, 2): its middle (2,) and its sides (S, 2), each the normal over the distance of a side from
    the middle; None where it has no area."""
    _, part = connected_parts(places, apart)
    size = np.bincount(part)
    try:
        hull = ConvexHull(places[(size >= MIN_CONNECTED * size.max())[part]])
    except (QhullError, ValueError):
        return None
    middle = hull.points[hull.vertices].mean(axis=0)
    distance = -(hull.equations[:, :2] @ middle + hull.equations[:, 2])
    return (middle, hull.equations[:, :2] / distance[:, None]) if (distance > 0).all() else None


def _outline_distance(outline: Outline, places: np.ndarray) -> np.ndarray:
    """(N,) how far places (N, 2) are from the middle of an outline: 1 on it, 2 at twice its size."""
    middle, sides = outline
    return np.asarray(((places - middle) @ sides.T).max(axis=1)) if len(places) else np.zeros(0)


def along(points: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """(N,) coordinates of points (N, 3) along a direction: in sums whose order no number of threads changes."""
    return np.asarray(points[:, 0] * direction[0] + points[:, 1] * direction[1] + points[:, 2] * direction[2])


def _plane(points: np.ndarray, tolerance: float, up: np.ndarray | None = None, least: float = 0.0) -> Plane | None:
    """Normal and offset of the plane with most of the points (N, 3) within a tolerance; of those alone whose normals have `least` along `up`, up or down."""
    if len(points) < 3:
        return None
    generator = np.random.default_rng(0)
    triple = points[generator.integers(0, len(points), (TRIES if up is None else 5 * TRIES, 3))]
    normals = np.cross(triple[:, 1] - triple[:, 0], triple[:, 2] - triple[:, 0])
    length = np.linalg.norm(normals, axis=1)
    good = length > 1e-12
    normals[good] /= length[good, None]
    if up is not None:
        good &= np.abs(along(normals, up)) >= least
    if not good.any():
        return None
    normals = normals[good]
    offsets = (normals * triple[good, 0]).sum(axis=1)
    counts = [(np.abs(along(points, normal) - offset) <= tolerance).sum() for normal, offset in zip(normals, offsets, strict=True)]
    best = int(np.argmax(counts))
    normal, offset = normals[best], float(offsets[best])
    for _ in range(3):
        near = points[np.abs(along(points, normal) - offset) <= tolerance]
        if len(near) < 3:
            break
        middle = near.mean(axis=0)
        normal = np.linalg.eigh(np.einsum("ni,nj->ij", near - middle, near - middle))[1][:, 0]
        offset = float(normal @ middle)
    return normal, offset


def with_feet(subject: np.ndarray, planes: Sequence[Plane]) -> np.ndarray:
    """Points (N, 3) of a subject, and the feet of those near a support on it: points that touch a plane count as plane."""
    size = float(np.ptp(subject, axis=0).max())
    feet = [subject]
    for normal, offset in planes:
        height = along(subject, normal) - offset
        near = height <= MAX_FOOT_HEIGHT * size
        feet.append(subject[near] - height[near, None] * normal)
    return np.concatenate(feet)
