"""Camera paths of a turntable: an orbit, a sway for captures from one side, the captured cameras', and LLFF's spiral for forward-facing scenes.

Where an asset has a foreground region that is its subject: paths have all of it in view, in the middle. Where it keeps the captured cameras, paths stay in the
part of the sphere that these cover, at their distance.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from efficientnerf.asset.captured import MetadataError, captured_of
from efficientnerf.asset.cascades import cascades_of
from efficientnerf.asset.region import inside_share
from efficientnerf.asset.tree import NerfTree
from efficientnerf.capture.captured_path import captured_path
from efficientnerf.capture.coverage import coverage
from efficientnerf.geometry.cameras import Camera, Similarity
from efficientnerf.geometry.ndc import Ndc
from efficientnerf.geometry.orbit import Orbit, rotation_to_z, stated_up

PATHS = ("auto", "orbit", "sway", "captured")
MAX_FITTED_FOV = 50.0  # degrees; with a larger one the camera would be too near, and moves back instead
MAX_REGION_FOV, MAX_SURROUNDING_FOV = 60.0, 75.0  # where the subject is a region, without its surroundings and with them
SWAY = 10.0  # degrees, where nothing says how far the captured cameras go
COVERED = 0.8  # of the captured cameras' range, that a sway uses. docs/experiments/foreground.md
FIT_MARGIN = 1.1  # of the field of view
OUTLIER_FRACTION = 0.005  # of the occupied cells, that may lie outside of the image: floaters at the border of the box
MAX_FITTED_POINTS = 4000
FEW_CELLS = 500  # of a region, of which corners are fitted in place of centres
LARGEST, SMALLEST = 1e30, 1e-30  # numbers of an asset beyond these overflow when they are squared
SPIRAL_TURNS = 2
SPIRAL_FOV_RATIO = 0.95  # field of view of a spiral over that which all images share


def orbit_of(tree: NerfTree) -> Orbit:
    """The orbit in the asset's metadata; without one, a circle round its box, 20 degrees above the horizon. Raises MetadataError."""
    centre = 0.5 * (np.asarray(tree.bounds_min) + np.asarray(tree.bounds_max))
    size = float(np.linalg.norm(np.asarray(tree.bounds_max) - np.asarray(tree.bounds_min)))
    given: Any = tree.metadata.get("orbit") or {}
    try:
        orbit = Orbit(
            centre=tuple(float(x) for x in given.get("centre", centre)),  # type: ignore[arg-type]
            radius=float(given.get("radius", 1.5 * size)),
            elevation=float(given.get("elevation", 20.0)),
            forward_facing=bool(given.get("forward_facing", False)),
            heading=float(given.get("heading", 0.0)),
        )
    except (AttributeError, OverflowError, TypeError, ValueError) as error:
        raise MetadataError(f"asset: its orbit cannot be read ({str(error)[:200]}). Bake it again.") from error
    numbers = [*orbit.centre, orbit.radius, orbit.elevation, orbit.heading]
    if len(orbit.centre) != 3 or not (np.abs(numbers) < LARGEST).all() or not orbit.radius > SMALLEST:
        expected = "a centre of three numbers, a positive radius and angles in degrees"
        raise MetadataError(f"asset: its orbit is {str(given)[:200]}; expected {expected}. Bake it again.")
    return orbit


def similarity_of(tree: NerfTree) -> Similarity:
    """world_from_capture in the asset's metadata; the identity without. Raises MetadataError."""
    given: Any = tree.metadata.get("world_from_capture")
    if given is None:
        return Similarity.identity()
    try:
        similarity = Similarity(float(given["scale"]), np.array(given["rotation"], np.float64), np.array(given["translation"], np.float64))
        rotation, translation = similarity.rotation, similarity.translation
        good = rotation.shape == (3, 3) and translation.shape == (3,) and similarity.scale > 0 and np.isfinite([similarity.scale, *translation]).all()
        if not good or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-5):
            raise ValueError("not a similarity")
    except (KeyError, OverflowError, TypeError, ValueError) as error:
        raise MetadataError(f"asset: its world_from_capture cannot be read ({str(error)[:200]}). Bake it again.") from error
    return similarity


def level_of(tree: NerfTree) -> np.ndarray | None:
    """(3, 3) rotation from the asset's frame to where z is the up that its metadata state, as someone set it; None where they state none."""
    up = stated_up(tree.metadata.get("up"))
    return None if up is None or tree.ndc is not None else rotation_to_z(similarity_of(tree).rotation @ up)


def pose_on_sphere(centre: Sequence[float], radius: float, azimuth: float, elevation: float) -> np.ndarray:
    """(4, 4) pose of an upright camera that looks at a point from a distance; angles in degrees, azimuth anticlockwise from +x, z up.

    Also straight above and below, where a cross product with the up vector is zero.
    """
    a, e = math.radians(azimuth), math.radians(elevation)
    outward = np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
    pose = np.eye(4)
    pose[:3, 0] = (-math.sin(a), math.cos(a), 0.0)  # right
    pose[:3, 1] = (math.sin(e) * math.cos(a), math.sin(e) * math.sin(a), -math.cos(e))  # down
    pose[:3, 2] = -outward
    pose[:3, 3] = np.asarray(centre) + radius * outward
    return pose


def turntable_poses(orbit: Orbit, frames: int, sway: float, rise: float | None) -> list[np.ndarray]:
    """A full circle; or, for a capture from one side, an ellipse of `sway` by `rise` degrees (None: half as much) about the mean camera. Both are closed."""
    turns = np.arange(frames) / frames
    rise = 0.5 * sway if rise is None else rise
    if orbit.forward_facing:
        angles = [(orbit.heading + sway * math.sin(2 * math.pi * t), orbit.elevation + rise * math.cos(2 * math.pi * t)) for t in turns]
    else:
        angles = [(orbit.heading + 360.0 * t, orbit.elevation) for t in turns]
    return [pose_on_sphere(orbit.centre, orbit.radius, azimuth, elevation) for azimuth, elevation in angles]


def spiral_poses(middle: np.ndarray, radii: Sequence[float], focus: float, frames: int) -> list[np.ndarray]:
    """The render path of LLFF and NeRF: two turns of an ellipse across the view axis and one period along it, looking at one point; closed.

    middle  (4, 4) pose of the reference camera
    radii   along its axes
    focus   depth of the point that is looked at
    """
    target = middle[:3, 3] + focus * middle[:3, 2]
    poses = []
    for turn in 2 * math.pi * SPIRAL_TURNS * np.arange(frames) / frames:
        place = middle[:3, 3] + middle[:3, :3] @ (np.array([math.cos(turn), math.sin(turn), math.sin(turn / SPIRAL_TURNS)]) * radii)
        forward = target - place
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):  # not finite where the two points coincide
            forward /= np.linalg.norm(forward)
            right = np.cross(middle[:3, 1], forward)
            right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], -1)
        pose[:3, 3] = place
        poses.append(pose)
    return poses


def occupied_points(tree: NerfTree) -> np.ndarray:
    """(N, 3) centres of occupied coarse cells of the subject, about MAX_FITTED_POINTS at most: those in the region, where there is one and it holds any; of a
    forward-facing asset the nearer half of them, of an empty asset the corners of its box."""
    points = cell_centres(tree)
    if not len(points) and tree.ndc is None:
        return np.stack(np.meshgrid(*np.stack([tree.bounds_min, tree.bounds_max]).T, indexing="ij"), -1).reshape(-1, 3)
    points = points[:: max(1, len(points) // MAX_FITTED_POINTS)]
    if tree.ndc is None:
        return points
    near = points[points[:, 2] <= np.quantile(points[:, 2], 0.5)]  # the rest may lie at infinity
    return np.asarray(tree.ndc.world(near))


def cell_centres(tree: NerfTree) -> np.ndarray:
    """(N, 3) centres of the occupied coarse cells of a tree's region in its inmost cascade, in its frame; of all that cascade where it has no region, or one
    that holds nothing.

    Where the region goes on beyond, as with a table and the floor round it, the inmost cascade is what most photographs have in view.
    """
    cascade = cascades_of(tree)[0]
    points = np.asarray(cascade.bounds_min) + (np.argwhere(cascade.brick_index >= 0) + 0.5) * (tree.brick * cascade.voxel)
    if tree.region is None:
        return points
    inside = inside_share(tree.region, points) > 0.5
    if tree.region.bricks is not None:
        inside &= np.asarray(tree.region.bricks, bool)[cascade.brick_index[cascade.brick_index >= 0]]
    if 0 < inside.sum() < FEW_CELLS:  # their size counts
        corners = np.argwhere(np.ones((2, 2, 2))) - 0.5
        spread = (points[inside][:, None] + corners * (tree.brick * cascade.voxel)).reshape(-1, 3)
        return np.clip(spread, *tree.region.bounds)
    return points[inside] if inside.any() else points


def fitted_field_of_view(poses: Sequence[np.ndarray], points: np.ndarray, aspect: float) -> tuple[float, float]:
    """Tangent of half the vertical field of view in which all poses have the points (N, 3) in view, but for OUTLIER_FRACTION of them, and the vertical
    shift of the principal point for that, as a tangent, downwards; infinity and 0 where a camera stands among the points.

    aspect  width over height of the image
    """
    local = np.stack([(points - pose[:3, 3]) @ pose[:3, :3] for pose in poses])  # (C, N, 3)
    near = local[..., 2] <= 0.02 * np.abs(local).max()
    depth = np.where(near, 1.0, local[..., 2])
    x, y = local[..., 0] / depth, local[..., 1] / depth

    def most(tangents: np.ndarray) -> float:
        return float(np.sort(np.where(near, np.inf, tangents).max(axis=0))[math.ceil((1.0 - OUTLIER_FRACTION) * len(points)) - 1])

    above, below = most(-y), most(y)
    if not math.isfinite(above + below):
        return math.inf, 0.0
    drop = 0.5 * (below - above)
    return most(np.maximum(np.abs(x) / aspect, np.abs(y - drop))), drop


def turntable_cameras(
    tree: NerfTree,
    *,
    frames: int,
    width: int,
    height: int,
    elevation: float | None = None,
    radius: float | None = None,
    fov: float | None = None,
    sway: float | None = None,
    path: str = "auto",
    surroundings: bool = False,
    unused: Callable[[str, str], object] = lambda name, path: None,
) -> list[Camera]:
    """The cameras of a turntable, pinholes in the training frame.

    elevation  degrees; None: that of the capture's cameras
    radius     distance from the centre in the capture's units; None: that of the capture's cameras, or more where the asset would not fit
    fov        vertical, degrees; None: so that the asset fits from everywhere, vertically centred
    sway       degrees, see turntable_poses; None: as far as the captured cameras go, or SWAY where the asset keeps none
    path       see PATHS; auto: a sway for a capture that does not go round, else an orbit; for a forward-facing asset a spiral among the capture's cameras,
               unless an elevation or a radius is given
    unused     takes each of elevation, radius and sway that is given and that the path has no use for, and what the path is
    surroundings  whether they are shown: then the camera does not move back, where something may be in the way, and sees wider instead

    Raises MetadataError for `captured` where the asset keeps no cameras, and for metadata that make no path.
    """
    if path == "captured":
        _leave_out(unused, "past the captured cameras", elevation=elevation, radius=radius, sway=sway)
        return captured_cameras(tree, frames, width, height, fov)
    if tree.ndc is not None and path == "auto" and elevation is None and radius is None:
        _leave_out(unused, "a spiral among the captured cameras", sway=sway)
        return _spiral_cameras(tree, tree.ndc, frames, width, height, fov)
    level = level_of(tree)
    points = occupied_points(tree) if level is None else occupied_points(tree) @ level.T
    orbit, amplitude, rise = _framed_orbit(tree, points, path, sway, level)
    if not orbit.forward_facing:
        _leave_out(unused, "a circle", sway=sway)
    distance = orbit.radius if radius is None else radius * similarity_of(tree).scale
    orbit = replace(orbit, radius=distance, elevation=orbit.elevation if elevation is None else elevation)
    widest = math.tan(math.radians((MAX_SURROUNDING_FOV if surroundings else MAX_FITTED_FOV if tree.region is None else MAX_REGION_FOV) / 2))

    def needed(poses: list[np.ndarray]) -> float:
        return FIT_MARGIN * fitted_field_of_view(poses, points, width / height)[0]

    poses = turntable_poses(orbit, frames, amplitude, rise)
    # Captures from one side have nothing beyond the borders of their images: without a region the camera keeps its distance, and the asset may be cropped.
    if radius is None and fov is None and not surroundings and (tree.region is not None or not orbit.forward_facing):
        for _ in range(60):
            if needed(poses) <= widest:
                break
            orbit = replace(orbit, radius=1.1 * orbit.radius)
            poses = turntable_poses(orbit, frames, amplitude, rise)
    half, drop = fitted_field_of_view(poses, points, width / height)
    half, drop = (min(widest, FIT_MARGIN * half), drop) if fov is None else (math.tan(math.radians(fov / 2)), 0.0)
    cameras = _pinholes(poses, width, height, 0.5 * height / half, drop)
    return cameras if level is None else [Similarity(1.0, level.T, np.zeros(3)).camera(camera) for camera in cameras]


def _pinholes(poses: Sequence[np.ndarray], width: int, height: int, focal: float, drop: float = 0.0) -> list[Camera]:
    """Cameras with so many pixels as focal length, and a shift of the principal point as `fitted_field_of_view` gives it."""
    lens = (focal, width / 2, height / 2 - focal * drop)
    return [Camera(f"frame_{k:04d}", width, height, "SIMPLE_PINHOLE", lens, pose) for k, pose in enumerate(poses)]


def _leave_out(unused: Callable[[str, str], object], path: str, **settings: float | None) -> None:
    """Tell which of these settings are given."""
    for name, value in settings.items():
        if value is not None:
            unused(name, path)


def _framed_orbit(
    tree: NerfTree, points: np.ndarray, path: str, sway: float | None, level: np.ndarray | None
) -> tuple[Orbit, float, float | None]:
    """The orbit round the subject's points (N, 3), and the amplitudes of its sway; points and orbit turned by `level`.

    A region's middle is the centre; without one it is what the cameras look at.
    """
    orbit, rise = orbit_of(tree), None
    captured = captured_of(tree.metadata)
    turn = np.eye(3) if level is None else level
    if level is not None:
        x, y, z = (level @ orbit.centre).tolist()
        orbit = replace(orbit, centre=(x, y, z))
    if tree.region is not None:
        low, high = np.quantile(points, [OUTLIER_FRACTION, 1 - OUTLIER_FRACTION], axis=0)
        x, y, z = (float(c) for c in (low + high) / 2)
        if captured is None:  # the distance to the nearest part of the orbit's centre stays
            away = float(np.linalg.norm(np.array([x, y, z]) - orbit.centre))
            orbit = replace(orbit, radius=max(orbit.radius, away))
        orbit = replace(orbit, centre=(x, y, z))
    if captured is not None:
        found = coverage(captured.centres @ turn.T, np.asarray(orbit.centre))
        if tree.region is not None and found.distance > SMALLEST:
            orbit = replace(orbit, radius=found.distance, elevation=found.elevation)
        if found.arc < 360:
            orbit = replace(orbit, forward_facing=True, heading=found.heading)
            if sway is None:
                sway, rise = COVERED * found.arc / 2, min(COVERED * found.heights, 0.25 * found.arc)
        else:
            orbit = replace(orbit, forward_facing=False)
    if path != "auto":
        orbit = replace(orbit, forward_facing=path == "sway")
    return orbit, SWAY if sway is None else sway, rise


def captured_cameras(tree: NerfTree, frames: int, width: int, height: int, fov: float | None) -> list[Camera]:
    """Cameras on the way of the captured ones, with about their field of view along the diagonal. Raises MetadataError where the asset keeps none."""
    captured = captured_of(tree.metadata)
    if captured is None:
        raise MetadataError("asset: it keeps no captured cameras, which the path `captured` follows. Bake it again, or choose another path.")
    focal = captured.focal * math.hypot(width, height) / math.hypot(captured.width, captured.height)
    if fov is not None:
        focal = 0.5 * height / math.tan(math.radians(fov / 2))
    return _pinholes(captured_path(list(captured.poses), frames), width, height, focal)


def _spiral_cameras(tree: NerfTree, ndc: Ndc, frames: int, width: int, height: int, fov: float | None) -> list[Camera]:
    """The cameras of `spiral_poses` by the asset's metadata; without, the reference camera in each frame. Raises MetadataError."""
    given: Any = tree.metadata.get("spiral") or {}
    try:
        radii = [float(x) for x in given.get("radii", (0.0, 0.0, 0.0))]
        focus = float(given.get("focus", 4 * ndc.near))
        across, down = (float(x) for x in given.get("tangents", (0.5, 0.5)))
    except (AttributeError, OverflowError, TypeError, ValueError) as error:
        raise MetadataError(f"asset: its spiral cannot be read ({str(error)[:200]}). Bake it again.") from error
    if len(radii) != 3 or not (np.abs([*radii, focus, across, down]) < LARGEST).all() or not min(focus, across, down) > SMALLEST:
        raise MetadataError(f"asset: its spiral is {str(given)[:200]}; expected three radii, a positive focus and two positive tangents. Bake it again.")
    half = SPIRAL_FOV_RATIO * min(down, across * height / width) if fov is None else math.tan(math.radians(fov / 2))
    poses = spiral_poses(ndc.world_from_camera, radii, focus, frames)
    if not np.isfinite(poses).all():  # the spiral may end in the point that it looks at
        raise MetadataError("asset: its spiral and its reference camera give no poses: two points coincide, or a number is too large. Bake it again.")
    return _pinholes(poses, width, height, 0.5 * height / half)
