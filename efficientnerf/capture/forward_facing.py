"""Forward-facing scenes: whether a capture is one, and the reference camera and bounds of its normalised device coordinates (NDC).

LLFF's recipe (Mildenhall et al. 2019; NeRF, appendix C) with two changes. The reference camera is the mean of the cameras, and its near plane lies
in front of all content. Its intrinsics are a scale alone, chosen so that equal steps along x and z in NDC are equally many pixels: x' = (2 n / B) x / z
with n the near plane and B the extent of the camera centres, so that cubic voxels fit. The constants are ratios of measured lengths.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.geometry.ndc import Ndc, ndc_distance

SPACES = ("auto", "box", "contracted", "ndc")
MAX_AXIS_ANGLE = 40.0  # degrees, between a view axis and the mean one
MAX_RAY_ANGLE = 65.0  # degrees, between any ray and the mean axis
NEAR_PLANE_RATIO = 0.8  # near plane over the depth of the nearest content
MAX_CAMERA_DEPTH_RANGE = 0.35  # range of the cameras' own depths over the depth of the nearest content
MAX_BOX_ASPECT = 4.0  # longest side of the NDC box over its depth
BORDER_PIXELS = 12  # along each side of an image
FAR_PLANE_RATIO = 1.2  # far plane over the depth of the farthest content; what lies beyond is rendered but not exported


@dataclass(frozen=True, eq=False)
class ForwardFacing:
    """A forward-facing scene in the training frame."""

    ndc: Ndc  # the reference camera
    bounds: np.ndarray  # (2, 3) of all rays of the cameras in NDC
    far: float  # depth from the reference camera beyond which nothing is exported, world units
    radii: tuple[float, float, float]  # (3,) ninth deciles of the cameras' distances from the reference camera along its axes, world units
    focus: float  # depth of the point that a spiral's cameras look at, world units
    tangents: tuple[float, float]  # (2,) of half the horizontal and vertical field of view that all images share


def detect_forward_facing(cameras: Sequence[Camera], depths: np.ndarray) -> ForwardFacing | str:
    """The forward-facing scene of cameras in the training frame, or a sentence on why they make none.

    depths  (C, 2) depth along each view axis of the nearest and of the farthest content, world units; nan where unknown
    """
    if not np.isfinite(depths).any(0).all():
        return "the depths of the content are unknown"
    centres = np.array([camera.centre for camera in cameras])
    axes = np.array([camera.forward for camera in cameras])
    pose = mean_pose(cameras)
    forward = pose[:3, 2]
    angle = float(np.degrees(np.arccos(np.clip(axes @ forward, -1, 1))).max())
    if angle > MAX_AXIS_ANGLE:
        return f"the view axes deviate by up to {angle:.0f} degrees from their mean; at most {MAX_AXIS_ANGLE:.0f} are supported"
    edges = [rays(camera, border_pixels(camera))[1] for camera in cameras]
    widest = float(np.degrees(np.arccos(np.clip(min(float((edge @ forward).min()) for edge in edges), -1, 1))))
    if widest > MAX_RAY_ANGLE:
        return f"rays deviate by up to {widest:.0f} degrees from the mean view axis; at most {MAX_RAY_ANGLE:.0f} are supported"
    along = (centres - pose[:3, 3]) @ forward
    near = near_plane_depth(cameras, depths[:, 0], edges, along, forward)
    depth_range = float(along.max() - along.min())
    if near <= 0 or depth_range > MAX_CAMERA_DEPTH_RANGE * (near - along.min()):
        return "the content does not lie in front of all of the cameras"
    far = FAR_PLANE_RATIO * float(np.nanmax(along + depths[:, 1]))
    ndc = Ndc(pose, *_reference_intrinsics(cameras, edges, centres, pose, near), near)
    offsets = (centres - pose[:3, 3]) @ pose[:3, :3]
    radii = np.quantile(np.abs(offsets), 0.9, axis=0)
    return ForwardFacing(
        ndc=ndc,
        bounds=ndc_bounds(ndc, cameras),
        far=max(far, 2 * near),
        radii=(float(radii[0]), float(radii[1]), float(radii[2])),
        # As in LLFF and NeRF: three quarters of the way from near to far, in inverse depth.
        focus=float(1 / (0.25 / (0.9 * np.nanmin(depths[:, 0])) + 0.75 / (5 * np.nanmax(depths[:, 1])))),
        tangents=(
            min(float(0.5 * camera.width / camera.intrinsics["fx"]) for camera in cameras),
            min(float(0.5 * camera.height / camera.intrinsics["fy"]) for camera in cameras),
        ),
    )


def mean_pose(cameras: Sequence[Camera]) -> np.ndarray:
    """(4, 4) pose with the mean centre, view axis and up vector of the cameras."""
    forward = np.mean([camera.forward for camera in cameras], axis=0)
    forward = forward / max(float(np.linalg.norm(forward)), 1e-12)
    right = np.cross(-np.mean([camera.up for camera in cameras], axis=0), forward)
    pose = np.eye(4)
    pose[:3, 0] = right / max(float(np.linalg.norm(right)), 1e-12)
    pose[:3, 1] = np.cross(forward, pose[:3, 0])
    pose[:3, 2] = forward
    pose[:3, 3] = np.mean([camera.centre for camera in cameras], axis=0)
    return pose


def border_pixels(camera: Camera) -> np.ndarray:
    """(4 BORDER_PIXELS, 2) pixel coordinates along the border of an image."""
    t = np.arange(BORDER_PIXELS) / BORDER_PIXELS
    sides = [(t, 0 * t), (1 + 0 * t, t), (1 - t, 1 + 0 * t), (0 * t, 1 - t)]
    return np.concatenate([np.stack([x * camera.width, y * camera.height], -1) for x, y in sides])


def near_plane_depth(cameras: Sequence[Camera], near: np.ndarray, edges: Sequence[np.ndarray], along: np.ndarray, forward: np.ndarray) -> float:
    """Depth of the reference camera's near plane: in front of the nearest content, which may lie anywhere in an image."""
    usual = float(np.nanmedian(near))
    found = []
    for camera, depth, edge, own in zip(cameras, near, edges, along, strict=True):
        depth = depth if np.isfinite(depth) else usual
        reach = depth / np.maximum(edge @ camera.forward, 1e-6)  # distances at which the edge's rays have that depth
        found.append(own + min(float((reach * (edge @ forward)).min()), depth * float(camera.forward @ forward)))
    return NEAR_PLANE_RATIO * min(found)


def _reference_intrinsics(
    cameras: Sequence[Camera], edges: Sequence[np.ndarray], centres: np.ndarray, pose: np.ndarray, near: float
) -> tuple[float, float, float]:
    """Focal length, width and height of the reference camera: the median focal length, and the square image that gives the wanted scale of x' to x / z."""
    focal = float(np.median([camera.intrinsics["fx"] for camera in cameras]))
    local = (centres - pose[:3, 3]) @ pose[:3, :3]
    baseline = float(np.ptp(local[:, :2], axis=0).max())
    points = np.concatenate([edge @ pose[:3, :3] for edge in edges])
    reach = float(np.ptp(points[:, :2] / points[:, 2:], axis=0).max()) + baseline / near  # range of x / z over all rays
    slope = float(np.clip(2 * near / max(baseline, 1e-9), 2 / reach, 2 * MAX_BOX_ASPECT / reach))
    side = 2 * focal / slope
    return focal, side, side


def ndc_bounds(ndc: Ndc, cameras: Sequence[Camera]) -> np.ndarray:
    """(2, 3) bounds in NDC of all rays of the images, from the near plane to infinity."""
    ends = []
    for camera in cameras:
        start, along, begin, ds_dt, dlogz_dt = ndc.rays(*rays(camera, border_pixels(camera)))
        length = ndc_distance(np.full(len(start), 1e12) + begin, begin, ds_dt, dlogz_dt)
        ends += [start, start + length[:, None] * along]
    corners = np.concatenate(ends)
    low, high = corners.min(0), corners.max(0)
    margin = 0.005 * (high - low)
    return np.array([[*(low - margin)[:2], -1.0], [*(high + margin)[:2], 1.0]])
