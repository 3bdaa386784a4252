"""From a capture's own frame to the training frame: up axis, scene bounds, orbit, near and far planes, space.

All of it is estimated from the cameras, and from the sparse points or alpha channels where there are any. The constants are ratios of measured
lengths.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from efficientnerf.capture.coverage import meeting_point
from efficientnerf.capture.forward_facing import ForwardFacing, detect_forward_facing
from efficientnerf.geometry.cameras import Camera, Similarity, project
from efficientnerf.geometry.orbit import Orbit, rotation_to_z
from pipeline.errors import BadInput
from stages.framing import scene_bounds
from stages.framing.near_planes import content_depths, near_far_planes
from stages.io.capture import Capture
from stages.io.reader import PhotoReader

WIDEST = 0.5  # of the content's depth, that forward-facing cameras may be apart from each other. docs/experiments/ndc.md
FRONT_AZIMUTH = -90.0  # degrees, of the mean camera in captures whose frame means nothing: it looks along +y, as front views do


@dataclass(frozen=True, eq=False)
class TrainingFrame:
    """The training frame of a capture."""

    world_from_capture: Similarity  # similarity from the capture's frame
    bounds: np.ndarray  # (2, 3) scene bounds in the training frame, centred on the origin, largest half extent 1
    orbit: Orbit  # of the cameras round the subject, training frame
    near_far_planes: np.ndarray  # (C, 2) of each photo, along the view axis, training frame
    space: str  # "box", "contracted" or "ndc"
    forward: ForwardFacing | None  # the forward-facing scene, for ndc alone
    silhouettes_cut: tuple[str, ...]  # names of the photographs whose silhouettes reach out of the bounds
    facts: dict[str, object]  # how each was found, for the report


def find_training_frame(
    capture: Capture, *, up: str = "auto", box: Sequence[float] | None = None, margin: float = 0.05, space: str = "auto", reader: PhotoReader | None = None
) -> TrainingFrame:
    """Choose the training frame and the scene bounds.

    up      "auto", or an axis of the capture's frame ("z", "-y", ...) that points up
    box     six numbers in the capture's frame, x y z of one corner and of the opposite one; None: estimated
    margin  added on each side of the bounds of sparse points, as a fraction of their longest side; silhouettes already bound the subject from outside
    space   "auto", "box", "contracted" or "ndc"
    reader  what alpha channels and masks keep, as far as it was read

    Raises BadInput for an empty box, and for ndc where the capture is not forward-facing.
    """
    cameras = [photo.camera for photo in capture.photos]
    if not cameras:
        raise BadInput("a capture without photographs cannot be framed.")
    upward, from_axes = up_vector(capture, up)
    turn = rotation_to_z(upward)
    cut: tuple[str, ...] = ()
    stated = _corners(box) if box is not None else None if capture.bounds is None else _corners(np.asarray(capture.bounds).ravel())
    focus, converging = focus_point(capture)
    if not from_axes and stated is None:
        turn = _turned_to_front(turn, cameras, focus)
    if stated is not None:
        corners = stated @ turn.T
        low, high, how = corners.min(0), corners.max(0), "given" if box is not None else "stated by the source"
    else:
        turned = Similarity(1.0, turn, np.zeros(3))
        found = scene_bounds.find_scene_bounds(capture, turned, turned.points(focus), converging, reader)
        low, high, how, cut = found.low, found.high, found.how, found.cut
        padding = margin * (high - low).max() if how == "sparse points" else 0.0
        low, high = low - padding, high + padding
    centre, half = (low + high) / 2, (high - low) / 2
    half = np.maximum(half, 0.02 * half.max())  # a flat subject gets some thickness
    scale = 1.0 / half.max()
    world = Similarity(float(scale), turn, -scale * centre)
    bounds = np.stack([-half, half]) * scale
    placed = [world.camera(camera) for camera in cameras]
    orbit = orbit_of(placed, np.clip(world.points(focus), *bounds))
    facts: dict[str, object] = {
        "up": [round(float(c), 6) for c in upward],
        "bounds_from": how,
        "converging": converging,
        "scale": float(scale),
    }
    if cut:
        facts["silhouettes_cut"] = list(cut)
    space, forward, facts["space_from"] = space_of(capture, placed, world, space)
    facts["space"] = space
    planes = near_far_planes(capture, placed, world, bounds, world.points(focus) if converging else None)
    return TrainingFrame(world, bounds, orbit, planes, space, forward, cut, facts)


def space_of(capture: Capture, placed: Sequence[Camera], world: Similarity, choice: str) -> tuple[str, ForwardFacing | None, str]:
    """The space of the field, the forward-facing scene where it is ndc, and how it was chosen."""
    usual = "contracted" if capture.background is None else "box"
    if choice in ("box", "contracted"):
        return choice, None, "given"
    if choice == "auto" and capture.background is not None:
        return usual, None, "objects before a constant background"
    depths = content_depths(capture, placed, world)
    found = detect_forward_facing(placed, depths)
    if choice == "auto" and capture.kind != "llff" and isinstance(found, ForwardFacing):
        spread = float(np.linalg.norm(np.ptp([camera.centre for camera in placed], axis=0)) / np.nanmedian(np.sqrt(depths.prod(axis=1))))
        if spread > WIDEST:
            return usual, None, f"the cameras are spread over {spread:.2f} times the depth of the content; at most {WIDEST} for normalised device coordinates"
    if isinstance(found, ForwardFacing):
        return "ndc", found, "given" if choice == "ndc" else "the capture is forward-facing"
    if choice == "ndc":
        raise BadInput(f"poses.space ndc: {found}. Choose contracted or box, or leave it out.")
    return usual, None, found


def up_vector(capture: Capture, choice: str) -> tuple[np.ndarray, bool]:
    """The unit vector that points up in the capture's frame, and whether it is exact (given or stated) instead of estimated."""
    if choice != "auto":
        axis = np.zeros(3)
        axis["xyz".index(choice[-1])] = -1.0 if choice[0] == "-" else 1.0
        return axis, True
    if capture.up is not None:
        return np.asarray(capture.up, np.float64) / np.linalg.norm(capture.up), True
    return estimated_up([photo.camera for photo in capture.photos]), False


def estimated_up(cameras: Sequence[Camera]) -> np.ndarray:
    """Cameras are held level more often than they are held at one pitch: up is perpendicular to their x axes, as nearly as can be.

    The smallest eigenvector of sum w x x^T - 0.01 sum w u u^T (x: right, u: up axes); the second term decides where all cameras look the
    same way and their x axes leave up free to turn about them. Reweighted, so that a few tilted photographs do not count.
    """
    right = np.array([camera.world_from_camera[:3, 0] for camera in cameras])
    above = np.array([camera.up for camera in cameras])
    weight = np.ones(len(cameras))
    up = above.mean(0)
    for _ in range(20):
        scatter = (right * weight[:, None]).T @ right - 0.01 * (above * weight[:, None]).T @ above
        up = np.linalg.eigh(scatter)[1][:, 0]
        weight = 1.0 / (1.0 + ((right @ up) / 0.1) ** 2)
    return up if (above @ up).sum() >= 0 else -up


def focus_point(capture: Capture) -> tuple[np.ndarray, bool]:
    """The point that the cameras look at, in the capture's frame, and whether their axes meet there.

    Robust least squares over the view axes. Where the axes are parallel, or meet
    behind the cameras, it is the point in front of the middle camera at the middle depth of the sparse points (else of near and far,
    else at four times the cameras' mean distance from their centre).
    """
    cameras = [photo.camera for photo in capture.photos]
    point, meeting = meeting_point(cameras)
    if meeting:
        return point, True
    centres = np.array([camera.centre for camera in cameras])
    forward = np.array([camera.forward for camera in cameras])
    mean_forward = forward.mean(0)
    middle = int(np.argmin(np.linalg.norm(centres - np.median(centres, axis=0), axis=1)))
    if np.linalg.norm(mean_forward) < 0.3:  # looking outwards, all round
        return centres.mean(0), False
    return centres[middle] + forward[middle] * _typical_depth(capture, centres), False


def _typical_depth(capture: Capture, centres: np.ndarray) -> float:
    if capture.points is not None and len(capture.points.xyz):
        depths = np.concatenate([project(photo.camera, capture.points.xyz)[1] for photo in capture.photos[:: max(1, len(capture.photos) // 20)]])
        if (depths > 0).any():
            return float(np.median(depths[depths > 0]))
    stated = [(photo.near, photo.far) for photo in capture.photos if photo.near and photo.far]
    if stated:
        near, far = np.median(np.array(stated, np.float64), axis=0)
        return float(2 / (1 / near + 1 / far))  # the middle in inverse depth
    return float(4 * np.linalg.norm(centres - centres.mean(0), axis=1).mean()) or 1.0


def _turned_to_front(turn: np.ndarray, cameras: Sequence[Camera], focus: np.ndarray) -> np.ndarray:
    """`turn`, followed by the rotation about z that brings the middle of the cameras to the front."""
    heading, _ = mean_azimuth(np.array([camera.centre - focus for camera in cameras]) @ turn.T)
    angle = np.radians(FRONT_AZIMUTH - heading)
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]) @ turn


def mean_azimuth(offsets: np.ndarray) -> tuple[float, bool]:
    """Azimuth of the middle of the cameras, degrees, and whether they keep to one side.

    offsets  (C, 3) from the subject to the cameras, z up

    The middle of the arc that is left when the widest gap between neighbouring azimuths is taken away; where there is no clear gap
    (under 60 degrees), the azimuth of the first camera.
    """
    azimuth = np.degrees(np.arctan2(offsets[:, 1], offsets[:, 0]))
    ordered = np.sort(azimuth)
    gaps = np.diff(np.append(ordered, ordered[0] + 360.0))
    widest = int(np.argmax(gaps))
    if gaps[widest] < 60.0:
        return float(azimuth[0]), False
    middle = ordered[widest] + gaps[widest] / 2 + 180.0
    return float((middle + 180.0) % 360.0 - 180.0), bool(gaps[widest] >= 180.0)


def orbit_of(cameras: Sequence[Camera], centre: np.ndarray) -> Orbit:
    """How cameras (training frame) stand around a point."""
    offsets = np.array([camera.centre for camera in cameras]) - centre
    distance = np.linalg.norm(offsets, axis=1)
    elevation = np.degrees(np.arcsin(np.clip(offsets[:, 2] / np.maximum(distance, 1e-12), -1, 1)))
    heading, one_side = mean_azimuth(offsets)
    return Orbit(
        centre=(float(centre[0]), float(centre[1]), float(centre[2])),
        radius=float(np.median(distance)),
        elevation=float(np.median(elevation)),
        forward_facing=one_side,
        heading=heading,
    )


def _corners(box: Sequence[float] | np.ndarray) -> np.ndarray:
    """(8, 3) corners of a box given by six numbers."""
    numbers = np.asarray(box, np.float64).ravel()
    if numbers.shape != (6,) or not np.isfinite(numbers).all():
        raise BadInput(f"crop box: found {len(numbers)} numbers, expected six finite ones: x y z of one corner and of the opposite one.")
    low, high = np.minimum(numbers[:3], numbers[3:]), np.maximum(numbers[:3], numbers[3:])
    if (high - low).min() <= 0:
        raise BadInput(f"crop box: has no volume ({low.tolist()} to {high.tolist()}).")
    return np.array([[(low, high)[i][0], (low, high)[j][1], (low, high)[k][2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
