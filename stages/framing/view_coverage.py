"""View coverage: how many training views have a point in view.

Density at any distance along its rays explains what one photograph alone shows. In unbounded scenes, the density voxels that fewer than
`train.min_views` views have in view are masked in the box; and outside it where they would stand before it for a camera that just misses them, and behind it
for those that show them. Their content is learned farther away instead. Occlusion is not considered. See docs/experiments/min-views.md.

A view counts only where its mask keeps the pixel: pixels that are left out tell nothing of what lies behind them. In scenes with masks, in every space, the
density voxels are masked, too, that no view shows by a pixel that is kept, so that nothing fills them.

Rays begin at their near plane: density before it costs a view nothing, yet other views put their background there, in the middle of the ring that the
cameras stand in, and an asset, whose rays begin at the eye, would show it as fog. In contracted scenes the density voxels before the near planes of
BEFORE_VIEWS views that have them in view are masked, and those close to the cameras and to the way from each to its neighbours.
See docs/experiments/near-cameras.md.

All round a subject, what only opposite views see lies in the open, too: the background behind the subject, learned among the cameras. These density voxels
are closed at first, so that it is learned farther away. See docs/experiments/near-cameras.md.

Reliable sparse points are evidence that space is filled: what would mask more than MAX_CONTRADICTED of them is refuted, and masks nothing. See docs/priors.md.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from efficientnerf.capture.coverage import meeting_point
from efficientnerf.geometry.cameras import Camera, project
from efficientnerf.geometry.spaces import Space
from stages.framing.scene_bounds import shows
from stages.io.scene import View, read_mask

Masks = Sequence[np.ndarray | None]  # (h, w) bool of each view at any size, True where pixels are kept; None: everywhere

MASK_SIZE = 256  # px, longest side of the masks that are looked at
BLOCK = 8  # density voxels along a side of the blocks that no view shows
COARSE = 32  # px, longest side of the masks that find such blocks: a pixel and its neighbours are wider than the points of a block are apart
CLEARANCE = 0.8  # of the near plane's distance: how far from the cameras' path nothing is. docs/experiments/near-cameras.md
REACH = 0.5  # of the way to where the cameras' axes meet, that a camera's near plane is taken to lie at most
MIN_DISTANCE = 0.5  # of the cameras' median distance from there: one that is nearer stands in the subject, or shows a detail of it
NEIGHBOURS = 8  # of a camera that its path leads to, where they are within twice the near plane's distance
BEFORE_VIEWS = 2  # that must have a voxel before their near planes, or a quarter of the cameras (rounded up) if that is less
MAX_CONTRADICTED = 0.03  # of the reliable sparse points, that a rule may declare empty: more refute it. docs/priors.md
NEAR_BLOCK = 2  # density voxels along a side of the blocks before the near planes
MAX_FRACTION = 4  # at most one in so many of the cameras (rounded up) is required
NEAREST = 0.1  # share of the cameras that may be nearer to the box's centre than what counts as standing before it
BEFORE, BEHIND = 0.75, 1.1  # of the depth of the box's centre: what is nearer to a camera stands before the box, what is farther away behind it
WIDENED = 1.5  # times a picture's sides: neighbouring cameras see what misses the picture by no more
AMONG = 45  # degrees, seen from the box's centre, within which a camera is farther away than what lies among the cameras
AMONG_BLOCK = 2  # density voxels along a side of the blocks that lie among them
AROUND_POINTS = 2  # such blocks round a reliable sparse point that are open from the first step
FEW_BLOCK = 2  # density voxels along a side of the blocks outside the box that few views show


def kept_pixels(folder: Path, views: Sequence[View]) -> Masks | None:
    """The masks of some views of a scene at small size, True where any pixel below is kept; None where no view has a mask."""
    masks = [None if mask is None else shrunk(mask, MASK_SIZE) for mask in (read_mask(folder, view) for view in views)]
    return None if all(mask is None for mask in masks) else masks


def cells_below_min_views(space: Space, cameras: Sequence[Camera], min_views: int, side: int, masks: Masks | None = None) -> np.ndarray:
    """(D, D, D) bool of the density voxels of a contracted space, D = `side`: those that are `poorly_seen`. Outside the box the middles of blocks of FEW_BLOCK
    voxels a side decide: contracted voxels are larger."""
    count = -(-side // FEW_BLOCK)
    lattice = np.minimum((np.arange(count) + 0.5) * (FEW_BLOCK / side), 1.0)
    grid = np.stack(np.meshgrid(*(lattice,) * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    out = poorly_seen(space.world(torch.from_numpy(grid)).numpy(), space.bounds, cameras, min_views, masks).reshape((count,) * 3)
    for axis in range(3):
        out = np.repeat(out, FEW_BLOCK, axis)
    out = out[:side, :side, :side]
    centre = (np.arange(side) + 0.5) / side * (2 * space.reach) - space.reach  # contraction is the identity in the box
    inside = np.flatnonzero(np.abs(centre) <= 1)
    unit = np.stack(np.meshgrid(*(centre[inside],) * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    few = ~has_min_views(unit * space.half + space.centre, cameras, min_views, masks)
    out[np.ix_(inside, inside, inside)] = few.reshape((len(inside),) * 3)
    return out


def poorly_seen(points: np.ndarray, bounds: np.ndarray, cameras: Sequence[Camera], min_views: int, masks: Masks | None = None) -> np.ndarray:
    """(N,) bool: the points (N, 3) of the world where density would be a guess that cameras between the given ones may see. `has_min_views` is false for
    them; they are in the box `bounds` (2, 3), or outside it, nearer to its centre than nine in ten of the cameras, where `stands_between` is true. A wall next
    to the subject, or the floor before it, stays where one view shows it."""
    low, high = np.asarray(bounds, np.float64)
    middle = (low + high) / 2
    reach = np.quantile([np.linalg.norm(camera.centre - middle) for camera in cameras], NEAREST)
    inside = ((points >= low) & (points <= high)).all(axis=1)
    at = np.flatnonzero(inside | (np.linalg.norm(points - middle, axis=1) < reach))
    at = at[~has_min_views(points[at], cameras, min_views, masks)]
    out = np.zeros(len(points), bool)
    out[at] = inside[at] | stands_between(points[at], cameras, middle)
    return out


def stands_between(points: np.ndarray, cameras: Sequence[Camera], middle: np.ndarray) -> np.ndarray:
    """(N,) bool: points (N, 3) that a camera has outside its picture, within WIDENED times its sides, nearer than BEFORE of the depth of `middle` (3,), while
    every camera that has them in view has them farther away than BEHIND of that depth."""
    before, behind = np.zeros(len(points), bool), np.ones(len(points), bool)
    for camera in cameras:
        pixels, depth = project(camera, points)
        subject = float((middle - camera.centre) @ camera.forward)
        with np.errstate(invalid="ignore"):
            off = np.abs(pixels / (camera.width, camera.height) * 2 - 1).max(axis=1)  # 1 at the picture's border
            before |= (depth > 0) & (depth < BEFORE * subject) & (off > 1) & (off <= WIDENED)
            behind &= ~((depth > 0) & (depth < BEHIND * subject) & (off <= 1))
    return before & behind


def has_min_views(points: np.ndarray, cameras: Sequence[Camera], min_views: int, masks: Masks | None = None) -> np.ndarray:
    """(N,) bool: which points (N, 3) of the world at least `min_views` cameras have in view, or a quarter of the cameras (rounded up) if that is less.

    masks  a camera counts only where its mask keeps the pixel
    """
    needed = min(min_views, -(-len(cameras) // MAX_FRACTION))
    count = np.zeros(len(points), np.int32)
    undecided = np.arange(len(points) if needed > 1 else 0)
    for n in bit_reversed_order(len(cameras)):
        ahead = undecided[(points[undecided] - cameras[n].centre) @ cameras[n].forward > 0]  # cheaper than to project all
        count[ahead] += shows(points[ahead], cameras[n], None if masks is None else masks[n])
        undecided = undecided[count[undecided] < needed]
    return (count >= needed) | (needed < 2)


def count_views(points: np.ndarray, cameras: Sequence[Camera], masks: Masks | None = None) -> np.ndarray:
    """(N,) int32: how many cameras have points (N, 3) of the world in view.

    masks  a camera counts only where its mask keeps the pixel
    """
    count = np.zeros(len(points), np.int32)
    for n, camera in enumerate(cameras):
        count += shows(points, camera, None if masks is None else masks[n])
    return count


def cells_without_view(space: Space, cameras: Sequence[Camera], side: int, masks: Masks) -> np.ndarray:
    """(D, D, D) bool of the density voxels of any space, D = `side`: those in blocks of which no view shows any point by a pixel that is kept.

    A block's corners are tried, the middles of its edges and faces, and its own, with masks whose kept parts are wider than these are apart. A point a
    little outside of a picture counts as seen.
    """
    count = -(-side // BLOCK)
    lattice = np.minimum(np.arange(2 * count + 1) * (BLOCK / 2 / side), 1.0)
    grid = np.stack(np.meshgrid(*(lattice,) * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    points = space.world(torch.from_numpy(grid))
    world = (points if space.ndc is None else space.ndc.world(points)).numpy()
    wide = [None if mask is None else _widened(shrunk(mask, COARSE)) for mask in masks]
    unseen = np.arange(len(world))
    for n in bit_reversed_order(len(cameras)):
        unseen = unseen[~shows(world[unseen], cameras[n], wide[n], margin=1 / COARSE)]
    free = np.zeros(len(world), bool)
    free[unseen] = True
    free = free.reshape((len(lattice),) * 3)
    for axis in range(3):  # all three points of a block along each axis
        first, middle, last = (np.take(free, np.arange(count) * 2 + offset, axis) for offset in range(3))
        free = first & middle & last
    for axis in range(3):
        free = np.repeat(free, BLOCK, axis)
    return free[:side, :side, :side]


def cells_among_cameras(space: Space, cameras: Sequence[Camera], side: int, filled: np.ndarray | None = None) -> np.ndarray:
    """(D, D, D) bool of the density voxels of a contracted space, D = `side`: those outside the box and `among` the cameras, by the middles of blocks.

    filled  (F, 3) reliable sparse points, round which there are none
    """
    count = -(-side // AMONG_BLOCK)
    lattice = np.minimum((np.arange(count) + 0.5) * (AMONG_BLOCK / side), 1.0)
    grid = np.stack(np.meshgrid(*(lattice,) * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    world, (low, high) = space.world(torch.from_numpy(grid)).numpy(), np.asarray(space.bounds, np.float64)
    at = np.flatnonzero(~((world >= low) & (world <= high)).all(axis=1))
    found = np.zeros((count,) * 3, bool)
    found.flat[at[among(world[at], cameras, (low + high) / 2)]] = True
    if filled is not None and len(filled):
        places = np.floor(space.grid(torch.from_numpy(np.asarray(filled, np.float64))).numpy() * count).astype(np.int64)
        points = np.zeros((count,) * 3, bool)
        points[tuple(places[((places >= 0) & (places < count)).all(axis=1)].T)] = True
        found &= ~binary_dilation(points, iterations=AROUND_POINTS)
    for axis in range(3):
        found = np.repeat(found, AMONG_BLOCK, axis)
    return found[:side, :side, :side]


def among(points: np.ndarray, cameras: Sequence[Camera], middle: np.ndarray) -> np.ndarray:
    """(N,) bool: points (N, 3) that, seen from `middle` (3,), have a camera within AMONG degrees and farther away, while every camera that has them in view
    has them farther away than BEHIND of the depth of `middle`."""
    order, ways = bit_reversed_order(len(cameras)), [camera.centre - middle for camera in cameras]
    distance = np.linalg.norm(points - middle, axis=1)
    out, undecided = np.zeros(len(points), bool), np.flatnonzero(distance < max(map(np.linalg.norm, ways)))
    to, distance = points[undecided] - middle, distance[undecided]
    for n in order:
        length = float(np.linalg.norm(ways[n]))
        close = (distance < length) & (to @ ways[n] > np.cos(np.radians(AMONG)) * length * distance)
        out[undecided[close]] = True
        undecided, to, distance = undecided[~close], to[~close], distance[~close]
    at = np.flatnonzero(out)
    some = points[at]
    for camera in (cameras[n] for n in order):
        depth = (some - camera.centre) @ camera.forward
        before = np.flatnonzero((depth > 0) & (depth < BEHIND * float((middle - camera.centre) @ camera.forward)))  # cheaper than to project all
        seen = before[shows(some[before], camera)]
        out[at[seen]] = False
        at, some = np.delete(at, seen), np.delete(some, seen, axis=0)
    return out


def cells_before_near(space: Space, cameras: Sequence[Camera], near: Sequence[float], side: int, filled: np.ndarray | None = None) -> np.ndarray:
    """(D, D, D) bool of the density voxels of a contracted space, D = `side`: those in blocks all of whose corners BEFORE_VIEWS views have in view before their
    near planes, or that lie within CLEARANCE of the cameras' path.

    filled  (F, 3) reliable sparse points; see `close_to_path`
    """
    count = -(-side // NEAR_BLOCK)
    lattice = np.minimum(np.arange(count + 1) * (NEAR_BLOCK / side), 1.0)
    grid = np.stack(np.meshgrid(*(lattice,) * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    world = space.world(torch.from_numpy(grid)).numpy()

    def blocks(corners: np.ndarray) -> np.ndarray:
        whole = corners.reshape((count + 1,) * 3)
        for axis in range(3):
            low, high = (np.take(whole, range(begin, begin + count), axis) for begin in (0, 1))
            whole = low & high
        return whole

    views = np.zeros((count,) * 3, np.int32)
    for camera, plane in zip(cameras, near, strict=True):
        depth = (world - camera.centre) @ camera.forward
        at = np.flatnonzero((depth > 0) & (depth < plane))
        corners = np.zeros(len(world), bool)
        corners[at[before_near(world[at], camera, plane)]] = True
        views += blocks(corners)
    found = views >= min(BEFORE_VIEWS, -(-len(cameras) // MAX_FRACTION))
    found |= blocks(close_to_path(world, cameras, near, filled=filled))
    for axis in range(3):
        found = np.repeat(found, NEAR_BLOCK, axis)
    return found[:side, :side, :side]


def close_to_path(
    points: np.ndarray, cameras: Sequence[Camera], near: Sequence[float], clearance: float = CLEARANCE, filled: np.ndarray | None = None
) -> np.ndarray:
    """(N,) bool: which points (N, 3) lie within `clearance` times the near plane's distance of a camera, or of the way to one of its nearest neighbours.

    filled  (F, 3) reliable sparse points: a camera that has more than MAX_CONTRADICTED of them so close stands where it cannot, and keeps nothing clear

    Where the cameras' axes meet in a point, none keeps the middle of the others' pictures clear (REACH), and one that strays there nothing (MIN_DISTANCE).
    """
    centres, plane = np.array([camera.centre for camera in cameras]), np.asarray(near, np.float64)
    middle, meeting = meeting_point(cameras)
    if meeting:
        distance = np.linalg.norm(centres - middle, axis=1)
        plane = np.minimum(plane, REACH * distance)
        stands = distance >= MIN_DISTANCE * np.median(distance)
        centres, plane = centres[stands], plane[stands]
    if filled is not None and len(filled):
        within = cKDTree(filled).query_ball_point(centres, clearance * plane, return_length=True)
        stands = within <= MAX_CONTRADICTED * len(filled)
        centres, plane = centres[stands], plane[stands]
    if not len(centres):
        return np.zeros(len(points), bool)
    count = min(NEIGHBOURS + 1, len(centres))
    distance, other = cKDTree(centres).query(centres, k=count)
    way, radius = [centres], [clearance * plane]
    for n, m in zip(*np.nonzero(np.reshape(distance, (-1, count)) <= 2 * plane[:, None]), strict=True):
        to = np.reshape(other, (-1, count))[n, m]
        steps = np.linspace(0, 1, 5)[1:-1, None]
        way.append(centres[n] + steps * (centres[to] - centres[n]))
        radius.append(np.full(len(steps), clearance * min(plane[n], plane[to])))
    found = np.zeros(len(points), bool)
    places, reach = np.concatenate(way), np.concatenate(radius)
    tree = cKDTree(points, compact_nodes=False, balanced_tree=False)  # which takes a third of the time to build
    for at in tree.query_ball_point(places, reach):
        found[at] = True
    return found


def contradicted(cells: np.ndarray, space: Space, filled: np.ndarray) -> float:
    """The share of the reliable sparse points (F, 3) of the world that lie in masked density voxels (D, D, D) bool; 0 where there are none."""
    points = torch.from_numpy(np.asarray(filled, np.float64))
    grid = space.grid(points if space.ndc is None else space.ndc.points(points)).numpy()
    grid = grid[((grid >= 0) & (grid <= 1)).all(axis=1)]
    at = np.minimum((grid * len(cells)).astype(np.int64), len(cells) - 1)
    return float(cells[tuple(at.T)].mean()) if len(at) else 0.0


def before_near(points: np.ndarray, camera: Camera, near: float) -> np.ndarray:
    """(N,) bool: which points (N, 3) a camera has in view before its near plane."""
    pixels, depth = project(camera, points)
    with np.errstate(invalid="ignore"):
        return np.asarray((depth > 0) & (depth < near) & (pixels >= 0).all(1) & (pixels <= (camera.width, camera.height)).all(1))


def shrunk(mask: np.ndarray, longest: int) -> np.ndarray:
    """(h, w) bool with a longest side of at most `longest`: whether any pixel of (H, W) below is True. Pixels lie in as many parts of each side."""
    height, width = (-(-side * longest // max(mask.shape)) if max(mask.shape) > longest else side for side in mask.shape)
    rows, columns = (np.arange(count) * side // count for count, side in ((height, mask.shape[0]), (width, mask.shape[1])))
    return np.asarray(np.maximum.reduceat(np.maximum.reduceat(mask, rows, axis=0), columns, axis=1))


def _widened(mask: np.ndarray) -> np.ndarray:
    """With the neighbours of every pixel that is True."""
    padded = np.pad(mask, 1)
    height, width = mask.shape
    return np.asarray(np.any([padded[i : i + height, j : j + width] for i in range(3) for j in range(3)], axis=0))


def bit_reversed_order(count: int) -> list[int]:
    """0 to count - 1 by reversed bits: neighbours in a sequence, whose views overlap, come late."""
    bits = max(1, (count - 1).bit_length())
    order = (int(f"{n:0{bits}b}"[::-1], 2) for n in range(2**bits))
    return [n for n in order if n < count]
