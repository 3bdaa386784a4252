"""Scene bounds of a capture: of its sparse points, of its visual hull, or of the volume that its cameras' frusta share."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial import cKDTree

from efficientnerf.geometry.cameras import Camera, Similarity, project, rays, resized
from stages.io.capture import Capture, Photo, SparsePoints
from stages.io.reader import PhotoReader

MIN_POINTS = 50  # sparse points
AROUND = 1.5  # of the median distance of cameras from where their axes meet: points farther away from there are background, whoever has them in view
MIN_VIEW_RATIO = 0.65  # views of a point over those of the points with most: below, it is background
MAX_CAMERAS = 48  # evenly spaced over the capture
GRID_SIZE = 32  # voxels along a side of the region searched
# docs/experiments/framing.md
QUORUMS = (0.5, 0.375, 0.25, 0.125, 0.0)  # of the photographs, that have a voxel of the visual hull in view: the first is taken that cuts nothing
MIN_VIEWS = 3  # that show a part of the subject at least
MAX_OUTSIDE = 0.005  # of a silhouette, that may be outside of the box
MAX_GROWTH = 4.0  # of the box's volume, by lower quorums

Ranges = Sequence[tuple[float | None, float | None]]


@dataclass(frozen=True, eq=False)
class SceneBounds:
    """Corners of an axis-aligned box."""

    low: np.ndarray
    high: np.ndarray
    how: str  # it was found, in words
    cut: tuple[str, ...] = ()  # names of the photographs whose silhouettes reach out of it


def find_scene_bounds(capture: Capture, turned: Similarity, focus: np.ndarray, converging: bool, reader: PhotoReader | None = None) -> SceneBounds:
    """The box of a capture, in the turned frame.

    turned      the rotation from the capture's frame to one with z up
    focus       what the cameras look at, in the turned frame
    converging  whether their axes meet there
    reader      what alpha channels and masks keep, as far as it was read
    """
    photos = chosen_photos(capture.photos)
    cameras = [turned.camera(photo.camera) for photo in photos]
    ranges = [(photo.near, photo.far) for photo in photos]
    bounded = capture.background is not None  # silhouettes are more exact than points, in bounded scenes
    for way in ("silhouettes", "sparse points") if bounded else ("sparse points", "silhouettes"):
        if way == "silhouettes":
            pictures = [(reader or PhotoReader()).silhouette(photo, capture.silhouettes) for photo in photos]
            hull = whole_visual_hull(pictures, cameras, ranges, focus, converging)
            if hull is not None:
                low, high = box_round(*hull)
                shares = shares_outside(pictures, silhouettes_outside(pictures, cameras, low, high))
                cut = tuple(photo.camera.name for photo, share in zip(photos, shares, strict=True) if share > MAX_OUTSIDE)
                return SceneBounds(low, high, way, cut if len(cut) >= MIN_VIEWS else ())
        elif capture.points is not None and len(capture.points.xyz) >= MIN_POINTS:
            found = bounds_of_points(replace(capture.points, xyz=turned.points(capture.points.xyz)), cameras, focus if converging else None)
            if found is not None:
                return SceneBounds(*found, way)
    return SceneBounds(*bounds_of_frusta(cameras, ranges, focus, converging), "camera frusta")


def chosen_photos(photos: Sequence[Photo]) -> list[Photo]:
    """At most `MAX_CAMERAS` of those that training may see, evenly spaced."""
    usable = [photo for photo in photos if photo.split in (None, "train")] or list(photos)
    return usable[:: max(1, -(-len(usable) // MAX_CAMERAS))]


def bounds_of_points(points: SparsePoints, cameras: Sequence[Camera], focus: np.ndarray | None) -> tuple[np.ndarray, np.ndarray] | None:
    """A box round the points that most cameras have in view; None if too few remain.

    focus  (3,) where the cameras' axes meet; None where they do not

    Points with few views are background. From one side all cameras have the background in view: there, the distance from the focus is limited, in
    forward-facing captures the depth. Where the cameras pass through the scene, as along a street, no point is in view of most, and the box holds what is near
    their path.
    """
    centres = np.array([camera.centre for camera in cameras])
    if focus is None and _cameras_pass_through(points.xyz, cameras, centres):
        return _bounds_of_path(points.xyz, centres)
    share = in_view(points.xyz, cameras).mean(0)
    keep = share >= MIN_VIEW_RATIO * np.quantile(share, 0.95)
    count = np.array([len(track) for track in points.tracks]) if points.tracks else np.full(len(points.xyz), 3)
    keep &= count >= min(3, int(np.quantile(count, 0.9)))
    if np.isfinite(points.error).any():
        keep &= ~(points.error > 3 * np.nanmedian(points.error))
    depth = np.median([project(camera, points.xyz)[1] for camera in cameras], axis=0)
    keep &= depth > 0
    if keep.sum() < MIN_POINTS:
        return None
    if focus is None:
        keep &= depth < 2.5 * np.median(depth[keep])
    else:
        near = keep & (np.linalg.norm(points.xyz - focus, axis=1) <= AROUND * np.median(np.linalg.norm(centres - focus, axis=1)))
        keep = near if near.sum() >= MIN_POINTS else keep
    kept = points.xyz[keep]
    kept = kept[~outliers(kept)]
    if len(kept) < MIN_POINTS:
        return None
    return np.quantile(kept, 0.002, axis=0), np.quantile(kept, 0.998, axis=0)


def _cameras_pass_through(xyz: np.ndarray, cameras: Sequence[Camera], centres: np.ndarray) -> bool:
    """Whether the cameras' path is longer than the usual depth of their content."""
    depths = [depth[inside] for inside, depth in ((shows(xyz, camera), project(camera, xyz)[1]) for camera in cameras) if inside.any()]
    extent = np.linalg.norm(np.quantile(centres, 0.9, axis=0) - np.quantile(centres, 0.1, axis=0))
    return bool(depths) and float(np.median([np.quantile(depth, 0.25) for depth in depths])) < float(extent)


def _bounds_of_path(xyz: np.ndarray, centres: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A box round the path and the points within twice the median distance from it."""
    distance = cKDTree(centres).query(xyz)[0]
    near = xyz[distance <= 2 * np.median(distance)]
    both = np.concatenate([np.quantile(near, [0.02, 0.98], axis=0), centres])
    return both.min(0), both.max(0)


def outliers(xyz: np.ndarray) -> np.ndarray:
    """(N,) bool: points whose distance to their fifth neighbour is more than four times the median."""
    count = min(5, len(xyz) - 1)
    if count < 1:
        return np.zeros(len(xyz), bool)
    distance = cKDTree(xyz).query(xyz, k=count + 1)[0][:, -1]
    return np.asarray(distance > 4.0 * np.median(distance))


def in_view(xyz: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """(C, N) bool: which points project into the images of which cameras."""
    return np.array([shows(xyz, camera) for camera in cameras]).reshape(len(cameras), len(xyz))


def shows(xyz: np.ndarray, camera: Camera, mask: np.ndarray | None = None, margin: float = 0.0) -> np.ndarray:
    """(N,) bool: which points (N, 3) a camera shows by a pixel that its mask (h, w), of any size, keeps.

    margin  how far outside of the picture counts as its border, as a share of its longest side
    """
    pixels, depth = project(camera, xyz)
    size, beyond = np.array([camera.width, camera.height]), margin * max(camera.width, camera.height)
    with np.errstate(invalid="ignore"):
        found = (depth > 0) & (pixels >= -beyond).all(1) & (pixels <= size + beyond).all(1)
    if mask is not None:
        at = np.flatnonzero(found)
        cells = np.clip((pixels[at] * (np.array(mask.shape[::-1]) / size)).astype(int), 0, np.array(mask.shape[::-1]) - 1)
        found[at] = mask[cells[:, 1], cells[:, 0]]
    return np.asarray(found)


def bounds_of_frusta(
    cameras: Sequence[Camera], ranges: Ranges, focus: np.ndarray, converging: bool, least: float = 0.9
) -> tuple[np.ndarray, np.ndarray]:
    """A box round the volume that most cameras have in view.

    least   share of the cameras, relative to the largest share found anywhere
    ranges  near and far plane of each camera where the source states them; the far fifth of the range in inverse depth is left out
    """
    centres = np.array([camera.centre for camera in cameras])
    reach = float(np.linalg.norm(focus - centres, axis=1).max())
    limits = [_depth_limits(near, far) for near, far in ranges]
    if converging:
        # Converging cameras show as much of the subject behind the focus point as in front of it.
        ahead = [float((focus - camera.centre) @ camera.forward) for camera in cameras]
        limits = [(near, max(far, 2 * at - near)) if np.isfinite(far) and at > near else (near, far) for (near, far), at in zip(limits, ahead, strict=True)]
    deepest = max((far for _, far in limits if np.isfinite(far)), default=0.0)
    reach = max(reach, deepest) if not converging else reach
    low, high = focus - reach, focus + reach
    for _ in range(2):  # the second pass refines the first
        xyz, step = voxel_centres(low, high)
        visible = in_view(xyz, cameras)
        for row, camera, (near, far) in zip(visible, cameras, limits, strict=True):
            depth = (xyz - camera.centre) @ camera.forward
            row &= (depth >= near) & (depth <= far)
        share = visible.mean(0)
        kept = xyz[share >= least * min(1.0, float(share.max()))]
        if not len(kept) or share.max() == 0:
            break
        low, high = kept.min(0) - step / 2, kept.max(0) + step / 2
    return low, high


def _depth_limits(near: float | None, far: float | None) -> tuple[float, float]:
    if near and far and far > near > 0:
        return near, 1.0 / (1.0 / far + 0.2 * (1.0 / near - 1.0 / far))
    return 0.0, np.inf


def whole_visual_hull(
    pictures: Sequence[np.ndarray | None], cameras: Sequence[Camera], ranges: Ranges, focus: np.ndarray, converging: bool
) -> tuple[np.ndarray, np.ndarray] | None:
    """`visual_hull` of a capture, of what as many photographs have in view as may be without that its box cuts silhouettes.

    The more photographs it takes, the nearer the box is; but of a subject that is photographed from near too, the ends are in view in few.
    """
    best, fewest, least = None, len(pictures) + MIN_VIEWS, np.inf
    for quorum in QUORUMS:
        # A wide region to start from: parts of the subject outside of close views are cut by the others.
        hull = visual_hull(pictures, cameras, *bounds_of_frusta(cameras, ranges, focus, converging, least=max(quorum, 0.05)), quorum)
        if hull is None:
            continue
        low, high = box_round(*hull)
        least = min(least, float((high - low).prod()))
        if (high - low).prod() > MAX_GROWTH * least:  # into such a box anything fits, damaged silhouettes too
            break
        cut = int((shares_outside(pictures, silhouettes_outside(pictures, cameras, low, high)) > MAX_OUTSIDE).sum())
        if cut <= fewest - MIN_VIEWS:
            best, fewest = hull, cut
        if fewest < MIN_VIEWS:
            break
    return best


def box_round(hull: np.ndarray, step: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the box of voxels with centres (N, 3) and sides (3,)."""
    return hull.min(0) - step / 2, hull.max(0) + step / 2


def silhouettes_outside(pictures: Sequence[np.ndarray | None], cameras: Sequence[Camera], low: np.ndarray, high: np.ndarray) -> list[np.ndarray | None]:
    """Of each silhouette (h, w) bool the pixels whose rays miss a box; None without one."""
    found: list[np.ndarray | None] = []
    for picture, camera in zip(pictures, cameras, strict=True):
        if picture is None:
            found.append(None)
            continue
        missing = np.array(picture)
        row, column = np.nonzero(picture)
        origins, directions = rays(resized(camera, picture.shape[1], picture.shape[0]), np.stack([column, row], axis=-1) + 0.5)
        directions = np.where(np.abs(directions) < 1e-12, 1e-12, directions)
        sides = np.stack([(low - origins) / directions, (high - origins) / directions])  # (2, N, 3)
        enters, leaves = sides.min(0).max(axis=1), sides.max(0).min(axis=1)
        missing[row, column] = (leaves < enters) | (leaves <= 0)
        found.append(missing)
    return found


def shares_outside(pictures: Sequence[np.ndarray | None], outside: Sequence[np.ndarray | None]) -> np.ndarray:
    """(C,) which share of each silhouette that is; 0 without one."""
    pairs = zip(pictures, outside, strict=True)
    return np.array([0.0 if picture is None or part is None else part.sum() / max(1, int(picture.sum())) for picture, part in pairs])


def visual_hull(
    pictures: Sequence[np.ndarray | None], cameras: Sequence[Camera], low: np.ndarray, high: np.ndarray, quorum: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """Centres (N, 3) of the voxels of the visual hull in a box, and the (3,) sides of a voxel; None unless half of the photos have a silhouette, or where
    the hull is empty.

    pictures  (h, w) bool of each photo: its silhouette, at any size; or None
    quorum    share of the photographs

    A voxel is carved where its whole projection is transparent in more than one in fifty photographs (whose silhouette may be damaged), or where
    less than the quorum of the photographs, or less than MIN_VIEWS, have it in view.
    """
    views = [(resized(camera, mask.shape[1], mask.shape[0]), mask) for camera, mask in zip(cameras, pictures, strict=True) if mask is not None]
    if len(views) < max(3, len(pictures) / 2):
        return None
    for _ in range(3):  # each pass refines the one before
        kept, step = voxel_centres(low, high)
        against, views_of = np.zeros(len(kept), int), np.zeros(len(kept), int)
        for camera, mask in views:
            inside, transparent = _transparent(camera, mask, kept, float(np.linalg.norm(step)) / 2)
            against, views_of = against + transparent, views_of + inside
            left = against <= len(views) // 50
            kept, against, views_of = kept[left], against[left], views_of[left]
        kept = kept[views_of >= max(MIN_VIEWS, quorum * len(views))]
        if not len(kept):
            return None
        low, high = box_round(kept, step)
    return kept, step


def _transparent(camera: Camera, mask: np.ndarray, xyz: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """(N,) bool twice: balls of this radius whose centre projects into the image, and those of them whose projection has no opaque pixel."""
    pixels, depth = project(camera, xyz)
    with np.errstate(invalid="ignore", divide="ignore"):
        reach = np.ceil(radius * camera.intrinsics["fx"] / depth) + 1  # px
        column, row = np.floor(pixels[:, 0]), np.floor(pixels[:, 1])
        inside = (depth > radius) & (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    # One distance transform of the image serves all balls.
    distance = cv2.distanceTransform(np.where(mask, np.uint8(0), np.uint8(1)), cv2.DIST_C, 3) if mask.any() else np.full(mask.shape, np.inf)
    out = np.zeros(len(xyz), bool)
    out[inside] = distance[row[inside].astype(int), column[inside].astype(int)] > reach[inside]
    return inside, out


def voxel_centres(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(GRID^3, 3) voxel centres of a box and the (3,) sides of a voxel."""
    step = (high - low) / GRID_SIZE
    axes = [low[d] + (np.arange(GRID_SIZE) + 0.5) * step[d] for d in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3), step
