"""Near and far planes of photographs in the training frame.

Rays of unbounded scenes begin at half the depth of the nearest content, since floaters form where they begin earlier. A photograph's own points do not
bound its content: on a plain subject its only sparse points may be those of the room behind. Points of others do: where three photographs agree on a point
that a fourth has in its picture, the fourth shows it or something nearer. The neighbours of a camera, and what all cameras look at, are two more bounds.
The nearest of the three counts. See docs/priors.md.

All rays end behind what is farthest in any picture: nearly all points of one may lie on a table, and the room behind it would be painted on a shell before
its walls. Farther out, a plain sky is learned in patches. docs/experiments/near-cameras.md

C photos, P points.
"""

from collections.abc import Sequence

import numpy as np

from efficientnerf.geometry.cameras import Camera, Similarity, project
from stages.framing.scene_bounds import shows
from stages.io.capture import Capture, SparsePoints

MIN_TRACK = 3  # photographs that observe a reliable point
MAX_ERROR = 2.0  # its reprojection error over the median
MIN_POINTS = 10  # in a picture, of which its content is judged
OUTLIER_SHARE, MAX_OUTLIERS = 0.01, 10  # share, and number, of the reliable points in a picture that may lie before its content, and behind it: outliers
NEAR_RATIO = 0.5  # near plane over the depth of the nearest content; over that of the point that all cameras look at, at most
NEIGHBOURS = 8  # cameras, nearest in place, among those whose axes are within 60 degrees
FAR_RATIO = 1.5  # far plane over the depth of the farthest content
MAX_FAR = 100.0  # far plane at most, over half of the box's longest side: contracted space ends at 64
MAX_OVER_NEIGHBOURS = 1.5  # near plane over the median of theirs


def near_far_planes(capture: Capture, placed: Sequence[Camera], world: Similarity, bounds: np.ndarray, focus: np.ndarray | None = None) -> np.ndarray:
    """(C, 2) depth range of each photo along its view axis, training frame.

    placed  the photos' cameras in the training frame
    bounds  (2, 3) scene bounds there
    focus   (3,) what the cameras look at, there; None where their axes do not meet

    A constant background: the depths of the box. Surroundings: from the near plane that the source states, or before the content, to beyond everything;
    where neither is known, from a twentieth of the way to the box.
    """
    boxes = np.array([_box_depths(camera, bounds) for camera in placed]).reshape(-1, 2)
    if capture.background is not None:
        return boxes
    content = content_depths(capture, placed, world)
    stated = np.array([bool(photo.near and photo.far) for photo in capture.photos])
    farthest = min(FAR_RATIO * float(np.fmax.reduce(content[~stated, 1], initial=0.0)), MAX_FAR)
    near, far = np.where(stated, 0.9, NEAR_RATIO) * content[:, 0], np.fmax(boxes[:, 1], np.where(stated, 1.1 * content[:, 1], farthest))
    caps = [MAX_OVER_NEIGHBOURS * of_neighbours(near, placed)]
    if focus is not None:
        caps.append(NEAR_RATIO * depths_in_picture(focus, placed))
    near = np.where(stated, near, np.fmin.reduce([near, *caps]))
    near = np.where(np.isnan(near), 0.05 * np.maximum(boxes[:, 0], 0.2 * boxes[:, 1]), near)
    return np.stack([np.minimum(near, 0.5 * far), far], axis=1)


def _box_depths(camera: Camera, bounds: np.ndarray) -> tuple[float, float]:
    """Depths at which a camera's rays may enter and leave a box (2, 3) round the origin."""
    corners = np.array([[bounds[i, 0], bounds[j, 1], bounds[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    depths = (corners - camera.centre) @ camera.forward
    far = max(float(depths.max()), 0.1)
    inside = bool((np.abs(camera.centre) <= bounds[1]).all())
    return (0.02 * far if inside else max(float(depths.min()), 0.02 * far)), far


def content_depths(capture: Capture, placed: Sequence[Camera], world: Similarity) -> np.ndarray:
    """(C, 2) depths, training frame, at which the content of each picture begins and ends: as the source states it, else by the reliable points that it has in
    view, whoever observes them; nan where these are fewer than MIN_POINTS."""
    found = np.full((len(placed), 2), np.nan)
    xyz = np.zeros((0, 3)) if capture.points is None else world.points(capture.points.xyz[reliable_points(capture.points, len(placed))])
    for row, photo, camera in zip(found, capture.photos, placed, strict=True):
        if photo.near and photo.far:
            row[:] = photo.near * world.scale, photo.far * world.scale
            continue
        depths = np.sort((xyz[shows(xyz, camera)] - camera.centre) @ camera.forward)
        if len(depths) >= MIN_POINTS:
            outside = min(int(OUTLIER_SHARE * len(depths)), MAX_OUTLIERS)
            row[:] = depths[outside], depths[-1 - outside]
    return found


def reliable_points(points: SparsePoints, views: int) -> np.ndarray:
    """(P,) bool: the sparse points that enough photographs observe, exactly enough, to be evidence that space is filled. All are where observers are
    unknown, as of depth sensors.

    views  number of photographs
    """
    counts = np.array([len(track) for track in points.tracks]) if any(points.tracks) else np.full(len(points.xyz), MIN_TRACK)
    known = points.error[np.isfinite(points.error)]
    inexact = points.error > MAX_ERROR * np.median(known) if len(known) else np.zeros(len(counts), bool)
    return np.asarray((counts >= min(MIN_TRACK, views)) & ~inexact)


def of_neighbours(near: np.ndarray, placed: Sequence[Camera]) -> np.ndarray:
    """(C,) the median of the near planes (C,) of each camera's neighbours that look much the same way; nan where fewer than three are known."""
    centres, forward = np.array([camera.centre for camera in placed]), np.array([camera.forward for camera in placed])
    found = np.full(len(placed), np.nan)
    for n in range(len(placed)):
        others = np.flatnonzero((forward @ forward[n] > 0.5) & np.isfinite(near) & (np.arange(len(placed)) != n))
        if len(others) >= 3:
            nearest = others[np.argsort(np.linalg.norm(centres[others] - centres[n], axis=1), kind="stable")[:NEIGHBOURS]]
            found[n] = np.median(near[nearest])
    return found


def depths_in_picture(point: np.ndarray, placed: Sequence[Camera]) -> np.ndarray:
    """(C,) depth of a point for the cameras that have it in their picture; nan for the others."""
    found = np.full(len(placed), np.nan)
    for n, camera in enumerate(placed):
        if shows(point[None], camera)[0]:
            found[n] = project(camera, point[None])[1][0]
    return found
