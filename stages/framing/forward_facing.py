"""Captures that all look the same way: whether one is, its reference camera for normalised device coordinates, and what the cameras show there.

LLFF's recipe (Mildenhall et al. 2019 and 2020) with two changes. The reference camera is the mean of the cameras; its near plane lies before
all that they show. Its picture is only a scale, and is chosen so that a step to the side that is as long as a step in depth means as many
pixels of either: x' = (2 n / B) x / z with B the extent of the cameras' places, so that cubic voxels fit. The constants are fractions of what
is measured; none has a unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.geometry.ndc import Ndc, ndc_distance
from stages.io.capture import Photo

SPACES = ("auto", "box", "contracted", "ndc")
WIDEST_AXIS = 40.0  # degrees between a view axis and the mean one
WIDEST_RAY = 65.0  # degrees between any ray and the mean axis: its tangent is as far as a picture reaches to the side at infinity
ROOM_BEFORE = 0.8  # of the nearest content's depth: where the near plane lies
DEEP_CLOUD = 0.35  # of the nearest content's depth, that the cameras' own depths may spread over
WIDEST_BOX = 4.0  # longest side of the box over its depth
BORDER = 12  # pixels looked at along each side of a picture
FAR_ROOM = 1.2  # times the depth of the farthest content: what lies beyond is a backdrop, which is drawn but not exported


@dataclass(frozen=True, eq=False)
class Forward:
    """A forward-facing capture, training frame.

    ndc       the reference camera
    bounds    (2, 3) the box in normalised device coordinates that holds all that the cameras show
    far       depth before the reference camera beyond which nothing is exported, world units
    radii     (3,) how far cameras stand from the reference camera along its axes (nine in ten of them), world units
    focus     depth of what they look at, world units
    tangents  (2,) of half the field of view, across and down, that all pictures cover
    """

    ndc: Ndc
    bounds: np.ndarray
    far: float
    radii: tuple[float, float, float]
    focus: float
    tangents: tuple[float, float]


def forward_of(cameras: Sequence[Camera], depths: np.ndarray) -> Forward | str:
    """The forward-facing capture that cameras of the training frame make, or a sentence on why they do not.

    depths  (C, 2) depth along each view axis of the nearest and of the farthest content, world units; nan where unknown
    """
    if not np.isfinite(depths).any(0).all():
        return "nothing says how near and how far the content lies"
    centres = np.array([camera.centre for camera in cameras])
    axes = np.array([camera.forward for camera in cameras])
    pose = mean_pose(cameras)
    forward = pose[:3, 2]
    angle = float(np.degrees(np.arccos(np.clip(axes @ forward, -1, 1))).max())
    if angle > WIDEST_AXIS:
        return f"the cameras look up to {angle:.0f} degrees away from their mean direction; {WIDEST_AXIS:.0f} is the most"
    edges = [rays(camera, border(camera))[1] for camera in cameras]
    widest = float(np.degrees(np.arccos(np.clip(min(float((edge @ forward).min()) for edge in edges), -1, 1))))
    if widest > WIDEST_RAY:
        return f"the pictures reach {widest:.0f} degrees away from the mean direction; {WIDEST_RAY:.0f} is the most"
    along = (centres - pose[:3, 3]) @ forward
    near = nearest(cameras, depths[:, 0], edges, along, forward)
    spread = float(along.max() - along.min())
    if near <= 0 or spread > DEEP_CLOUD * (near - along.min()):
        return "the content does not lie before all of the cameras"
    far = FAR_ROOM * float(np.nanmax(along + depths[:, 1]))
    ndc = Ndc(pose, *_picture(cameras, edges, centres, pose, near), near)
    offsets = (centres - pose[:3, 3]) @ pose[:3, :3]
    radii = np.quantile(np.abs(offsets), 0.9, axis=0)
    return Forward(
        ndc=ndc,
        bounds=box_shown(ndc, cameras),
        far=max(far, 2 * near),
        radii=(float(radii[0]), float(radii[1]), float(radii[2])),
        # What the render path of LLFF and NeRF looks at: three quarters of the way from near to far, in depth's inverse.
        focus=float(1 / (0.25 / (0.9 * np.nanmin(depths[:, 0])) + 0.75 / (5 * np.nanmax(depths[:, 1])))),
        tangents=_tangents(cameras),
    )


def mean_pose(cameras: Sequence[Camera]) -> np.ndarray:
    """(4, 4) of a camera at the mean place, looking along the mean axis, with the mean up."""
    forward = np.mean([camera.forward for camera in cameras], axis=0)
    forward = forward / max(float(np.linalg.norm(forward)), 1e-12)
    right = np.cross(-np.mean([camera.up for camera in cameras], axis=0), forward)
    pose = np.eye(4)
    pose[:3, 0] = right / max(float(np.linalg.norm(right)), 1e-12)
    pose[:3, 1] = np.cross(forward, pose[:3, 0])
    pose[:3, 2] = forward
    pose[:3, 3] = np.mean([camera.centre for camera in cameras], axis=0)
    return pose


def border(camera: Camera) -> np.ndarray:
    """(4 BORDER, 2) pixels round the edge of a picture."""
    t = np.arange(BORDER) / BORDER
    sides = [(t, 0 * t), (1 + 0 * t, t), (1 - t, 1 + 0 * t), (0 * t, 1 - t)]
    return np.concatenate([np.stack([x * camera.width, y * camera.height], -1) for x, y in sides])


def nearest(cameras: Sequence[Camera], near: np.ndarray, edges: Sequence[np.ndarray], along: np.ndarray, forward: np.ndarray) -> float:
    """Depth before the reference camera of the near plane: before the nearest content, which may lie anywhere in a picture."""
    usual = float(np.nanmedian(near))
    found = []
    for camera, depth, edge, own in zip(cameras, near, edges, along, strict=True):
        depth = depth if np.isfinite(depth) else usual
        reach = depth / np.maximum(edge @ camera.forward, 1e-6)  # distances at which the edge's rays have that depth
        found.append(own + min(float((reach * (edge @ forward)).min()), depth * float(camera.forward @ forward)))
    return ROOM_BEFORE * min(found)


def _picture(cameras: Sequence[Camera], edges: Sequence[np.ndarray], centres: np.ndarray, pose: np.ndarray, near: float) -> tuple[float, float, float]:
    """Focal length, width and height of the reference camera: the cameras' own focal length, and a square that gives the wanted slope."""
    focal = float(np.median([camera.intrinsics["fx"] for camera in cameras]))
    local = (centres - pose[:3, 3]) @ pose[:3, :3]
    baseline = float(np.ptp(local[:, :2], axis=0).max())
    points = np.concatenate([edge @ pose[:3, :3] for edge in edges])
    reach = float(np.ptp(points[:, :2] / points[:, 2:], axis=0).max()) + baseline / near  # of x / z over all that is shown
    slope = float(np.clip(2 * near / max(baseline, 1e-9), 2 / reach, 2 * WIDEST_BOX / reach))
    side = 2 * focal / slope
    return focal, side, side


def box_shown(ndc: Ndc, cameras: Sequence[Camera]) -> np.ndarray:
    """(2, 3) the box in normalised device coordinates that all rays of the pictures run in, from the near plane to infinity."""
    ends = []
    for camera in cameras:
        start, along, begin, ds_dt, dlogz_dt = ndc.rays(*rays(camera, border(camera)))
        length = ndc_distance(np.full(len(start), 1e12) + begin, begin, ds_dt, dlogz_dt)
        ends += [start, start + length[:, None] * along]
    corners = np.concatenate(ends)
    low, high = corners.min(0), corners.max(0)
    room = 0.005 * (high - low)
    return np.array([[*(low - room)[:2], -1.0], [*(high + room)[:2], 1.0]])


def _tangents(cameras: Sequence[Camera]) -> tuple[float, float]:
    across = min(0.5 * camera.width / camera.intrinsics["fx"] for camera in cameras)
    down = min(0.5 * camera.height / camera.intrinsics["fy"] for camera in cameras)
    return float(across), float(down)


def content_depths(photos: Sequence[Photo], placed: Sequence[Camera], scale: float, points: np.ndarray | None, tracks: Sequence[Sequence[int]]) -> np.ndarray:
    """(C, 2) nearest and farthest depth of what each photo shows, training frame: as the source states it, else of the sparse points it observes.

    points     (N, 3) in the training frame, or None
    tracks     for each point, the photos that observe it
    """
    seen: list[list[int]] = [[] for _ in placed]
    for point, views in enumerate(tracks):
        for view in views:
            seen[view].append(point)
    rows = np.full((len(placed), 2), np.nan)
    for row, photo, camera, mine in zip(rows, photos, placed, seen, strict=True):
        if photo.near and photo.far:
            row[:] = photo.near * scale, photo.far * scale
        elif points is not None and len(mine) >= 10:
            depth = (points[mine] - camera.centre) @ camera.forward
            depth = depth[depth > 0]
            if len(depth):
                row[:] = np.quantile(depth, 0.01), np.quantile(depth, 0.99)
    return rows
