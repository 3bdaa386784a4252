"""Camera paths: the turntable's orbit, a small sway for captures from one side, and nerfstudio's camera_path.json; and drawing them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from efficientnerf.geometry.cameras import Camera, Similarity, pose_from_opengl
from pipeline.errors import BadInput
from stages.io.json_file import read_json
from stages.io.scene import Orbit

if TYPE_CHECKING:
    from efficientnerf.asset.rendering import Rendering
    from efficientnerf.asset.tree import NerfTree
    from efficientnerf.geometry.ndc import Ndc

MAX_FITTED_FOV = 50.0  # degrees: beyond it a picture is all perspective, so the camera steps back instead
FIT_MARGIN = 1.1  # air around what is shown
OUTLIER_FRACTION = 0.005  # share of the occupied cells that may leave the picture: specks at the edge of the box do not decide how large the subject is
MAX_FITTED_POINTS = 4000
SPIRAL_TURNS = 2
SPIRAL_FOV_RATIO = 0.95  # of the field of view that all pictures cover: what a spiral shows, so that it seldom leaves them
MAX_FILE = 64 << 20
MAX_SIZE = 16384
MAX_CAMERAS = 100_000


@dataclass(frozen=True, eq=False)
class CameraPath:
    """Cameras in the training frame, one for each frame, and the frames per second that the file asks for (None: it does not say)."""

    cameras: tuple[Camera, ...]
    fps: int | None


def orbit_of(tree: NerfTree) -> Orbit:
    """The orbit that the asset carries; for one without, a circle around its box, 20 degrees above the horizon."""
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
    except (AttributeError, TypeError, ValueError) as error:
        raise BadInput(f"asset: its orbit cannot be read ({error}). Bake it again.") from error
    if len(orbit.centre) != 3 or not np.isfinite([*orbit.centre, orbit.radius, orbit.elevation, orbit.heading]).all() or orbit.radius <= 0:
        raise BadInput(f"asset: its orbit is {given}; expected a centre of three numbers, a positive radius and angles in degrees. Bake it again.")
    return orbit


def similarity_of(tree: NerfTree) -> Similarity:
    """world_from_capture as the asset carries it; the identity where it does not."""
    given: Any = tree.metadata.get("world_from_capture")
    if given is None:
        return Similarity.identity()
    try:
        similarity = Similarity(float(given["scale"]), np.array(given["rotation"], np.float64), np.array(given["translation"], np.float64))
        rotation, translation = similarity.rotation, similarity.translation
        good = rotation.shape == (3, 3) and translation.shape == (3,) and similarity.scale > 0 and np.isfinite([similarity.scale, *translation]).all()
        if not good or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-5):
            raise ValueError("not a similarity")
    except (KeyError, TypeError, ValueError) as error:
        raise BadInput(f"asset: its world_from_capture cannot be read ({error}). Bake it again.") from error
    return similarity


def pose_on_sphere(centre: Sequence[float], radius: float, azimuth: float, elevation: float) -> np.ndarray:
    """(4, 4) pose of an upright camera that looks at a point from a distance; angles in degrees, azimuth anticlockwise from +x, z up.

    Written out rather than crossed with the up vector: it holds straight above and below as well.
    """
    a, e = math.radians(azimuth), math.radians(elevation)
    outward = np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
    pose = np.eye(4)
    pose[:3, 0] = (-math.sin(a), math.cos(a), 0.0)  # right
    pose[:3, 1] = (math.sin(e) * math.cos(a), math.sin(e) * math.sin(a), -math.cos(e))  # down
    pose[:3, 2] = -outward
    pose[:3, 3] = np.asarray(centre) + radius * outward
    return pose


def turntable_poses(orbit: Orbit, frames: int, *, sway: float) -> list[np.ndarray]:
    """A full circle; or, for a capture from one side, an ellipse of `sway` by half of it degrees about the middle of its cameras. Both close."""
    turns = np.arange(frames) / frames
    if orbit.forward_facing:
        angles = [(orbit.heading + sway * math.sin(2 * math.pi * t), orbit.elevation + 0.5 * sway * math.cos(2 * math.pi * t)) for t in turns]
    else:
        angles = [(orbit.heading + 360.0 * t, orbit.elevation) for t in turns]
    return [pose_on_sphere(orbit.centre, orbit.radius, azimuth, elevation) for azimuth, elevation in angles]


def spiral_poses(middle: np.ndarray, radii: Sequence[float], focus: float, frames: int) -> list[np.ndarray]:
    """The render path of LLFF and NeRF: twice round an ellipse across the view axis, once to and fro along it, always towards one point. It closes.

    middle  (4, 4) pose of the reference camera
    radii   extents along its axes; inside of those of the cameras nothing comes into view that none of them saw
    focus   depth of the point before `middle` that is looked at
    """
    target = middle[:3, 3] + focus * middle[:3, 2]
    poses = []
    for turn in 2 * math.pi * SPIRAL_TURNS * np.arange(frames) / frames:
        place = middle[:3, 3] + middle[:3, :3] @ (np.array([math.cos(turn), math.sin(turn), math.sin(turn / SPIRAL_TURNS)]) * radii)
        forward = target - place
        forward /= np.linalg.norm(forward)
        right = np.cross(middle[:3, 1], forward)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], -1)
        pose[:3, 3] = place
        poses.append(pose)
    return poses


def occupied_points(tree: NerfTree) -> np.ndarray:
    """(N, 3) centres of the coarse cells that hold something, some thousands of them at most; of an empty asset the corners of its box.

    Of a forward-facing asset the nearer half of them.
    """
    cells = np.argwhere(tree.brick_index >= 0)
    if not len(cells) and tree.ndc is None:
        return np.stack(np.meshgrid(*np.stack([tree.bounds_min, tree.bounds_max]).T, indexing="ij"), -1).reshape(-1, 3)
    cells = cells[:: max(1, len(cells) // MAX_FITTED_POINTS)]
    points = np.asarray(tree.bounds_min) + (cells + 0.5) * (tree.brick * tree.voxel)
    if tree.ndc is None:
        return points
    near = points[points[:, 2] <= np.quantile(points[:, 2], 0.5)]  # what lies further may lie at infinity
    return np.asarray(tree.ndc.world(near))


def fitted_field_of_view(poses: Sequence[np.ndarray], points: np.ndarray, aspect: float) -> tuple[float, float]:
    """Tangents of half the vertical field of view in which all poses see the points (N, 3), but for a few strays, and of how far below the middle of their
    view its middle has to lie for that; infinite and 0 where they stand among the points.

    From above the near side of what lies flat takes up more of a picture than the far side does, which would be left empty as far up.

    aspect  width over height of the picture
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
    sway: float = 10.0,
) -> list[Camera]:
    """The cameras of a turntable, pinholes in the training frame.

    elevation  degrees; None: as the capture's cameras stood
    radius     distance from the centre in the capture's units; None: as the capture's cameras stood, or further where the asset would not fit
    fov        vertical, degrees, about the centre; None: so that the asset fits from everywhere, with as much room below it as above
    sway       degrees; see turntable_poses

    For a forward-facing asset the path is a spiral among the capture's cameras, unless an elevation or a radius is asked for.
    """
    if tree.ndc is not None and elevation is None and radius is None:
        return _spiral_cameras(tree, tree.ndc, frames, width, height, fov)
    orbit = orbit_of(tree)
    distance = orbit.radius if radius is None else radius * similarity_of(tree).scale
    orbit = Orbit(orbit.centre, distance, orbit.elevation if elevation is None else elevation, orbit.forward_facing, orbit.heading)
    points = occupied_points(tree)
    widest = math.tan(math.radians(MAX_FITTED_FOV / 2))

    def needed(poses: list[np.ndarray]) -> float:
        return FIT_MARGIN * fitted_field_of_view(poses, points, width / height)[0]

    poses = turntable_poses(orbit, frames, sway=sway)
    # Captures from one side show nothing of what lies beyond their pictures, so there the camera stays and the asset may leave the picture.
    if radius is None and fov is None and not orbit.forward_facing:
        for _ in range(60):
            if needed(poses) <= widest:
                break
            orbit = Orbit(orbit.centre, 1.1 * orbit.radius, orbit.elevation, orbit.forward_facing, orbit.heading)
            poses = turntable_poses(orbit, frames, sway=sway)
    half, drop = fitted_field_of_view(poses, points, width / height)
    half, drop = (min(widest, FIT_MARGIN * half), drop) if fov is None else (math.tan(math.radians(fov / 2)), 0.0)
    focal = 0.5 * height / half
    lens = (focal, width / 2, height / 2 - focal * drop)
    return [Camera(f"frame_{k:04d}", width, height, "SIMPLE_PINHOLE", lens, pose) for k, pose in enumerate(poses)]


def _spiral_cameras(tree: NerfTree, ndc: Ndc, frames: int, width: int, height: int, fov: float | None) -> list[Camera]:
    """The cameras of `spiral_poses` as the asset records it; for one that records none, the reference camera stands still."""
    given: Any = tree.metadata.get("spiral") or {}
    try:
        radii = [float(x) for x in given.get("radii", (0.0, 0.0, 0.0))]
        focus = float(given.get("focus", 4 * ndc.near))
        across, down = (float(x) for x in given.get("tangents", (0.5, 0.5)))
    except (AttributeError, TypeError, ValueError) as error:
        raise BadInput(f"asset: its spiral cannot be read ({error}). Bake it again.") from error
    if len(radii) != 3 or not np.isfinite([*radii, focus, across, down]).all() or min(focus, across, down) <= 0:
        raise BadInput(f"asset: its spiral is {str(given)[:200]}; expected three radii, a positive focus and two positive tangents. Bake it again.")
    half = SPIRAL_FOV_RATIO * min(down, across * height / width) if fov is None else math.tan(math.radians(fov / 2))
    focal = 0.5 * height / half
    poses = spiral_poses(ndc.world_from_camera, radii, focus, frames)
    return [Camera(f"frame_{k:04d}", width, height, "SIMPLE_PINHOLE", (focal, width / 2, height / 2), pose) for k, pose in enumerate(poses)]


def read_camera_path(path: Path, world_from_capture: Similarity, *, width: int | None = None, height: int | None = None) -> CameraPath:
    """The cameras of nerfstudio's camera_path.json.

    path                file whose camera_to_world are in the capture's frame: 16 numbers row by row, x right, y up, looking along -z
    world_from_capture  takes them to the training frame
    width, height       in place of the file's render_width and render_height; with one of them the other follows

    BadInput says what is wrong with the file.
    """
    document = read_json(path, "Expected a camera path as nerfstudio's viewer exports it.", limit=MAX_FILE)
    if not isinstance(document, dict) or not isinstance(document.get("camera_path"), list):
        hint = " It looks like a data set: `enerf run` reads those." if isinstance(document, dict) and "frames" in document else ""
        raise BadInput(f"{path}: no list `camera_path`; expected a camera path as nerfstudio's viewer exports it.{hint}")
    kind = document.get("camera_type", "perspective")
    if kind != "perspective":
        raise BadInput(f"{path}: camera_type {str(kind)[:40]!r}; only perspective paths can be drawn.")
    entries = document["camera_path"]
    if not 1 <= len(entries) <= MAX_CAMERAS:
        raise BadInput(f"{path}: camera_path holds {len(entries)} cameras; expected 1 to {MAX_CAMERAS}.")
    size = _size(document, path, width, height)
    cameras = []
    for k, entry in enumerate(entries):
        where = f"{path}: camera_path[{k}]"
        if not isinstance(entry, dict):
            raise BadInput(f"{where}: expected an object, found {_shown(entry)}.")
        pose = world_from_capture.pose(_pose(entry.get("camera_to_world"), where))
        vertical = _number(entry.get("fov", document.get("default_fov")), f"{where}.fov", "degrees between 0 and 180", 0.0, 180.0)
        focal = 0.5 * size[1] / math.tan(math.radians(vertical / 2))
        cameras.append(Camera(f"frame_{k:04d}", size[0], size[1], "SIMPLE_PINHOLE", (focal, size[0] / 2, size[1] / 2), pose))
    fps = document.get("fps")
    return CameraPath(tuple(cameras), None if fps is None else max(1, round(_number(fps, f"{path}: fps", "frames per second", 0.0, 1000.0))))


def _size(document: dict[str, Any], path: Path, width: int | None, height: int | None) -> tuple[int, int]:
    if width is not None and height is not None:
        return width, height
    found = []
    for name in ("render_width", "render_height"):
        value = _number(document.get(name), f"{path}: {name}", f"a whole number from 1 to {MAX_SIZE}", 0.0, MAX_SIZE + 1.0)
        if value != int(value):
            raise BadInput(f"{path}: {name} is {value:g}; expected a whole number.")
        found.append(int(value))
    if width is not None:
        return width, max(1, round(width * found[1] / found[0]))
    if height is not None:
        return max(1, round(height * found[0] / found[1])), height
    return found[0], found[1]


def _pose(value: Any, where: str) -> np.ndarray:
    """camera_to_world with the project's axes, its rotation made exactly orthonormal."""
    where = f"{where}.camera_to_world"
    if not isinstance(value, list) or len(value) != 16 or any(isinstance(x, bool) or not isinstance(x, int | float) for x in value):
        raise BadInput(f"{where}: expected 16 numbers, found {_shown(value)}.")
    if any(abs(x) > 1e100 for x in value):  # also infinity, and integers that no float holds
        raise BadInput(f"{where}: holds a number that is not finite.")
    matrix = np.array(value, np.float64).reshape(4, 4)
    if not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6):
        hint = " It looks transposed; write it row by row." if np.allclose(matrix[:, 3], (0, 0, 0, 1), atol=1e-6) else ""
        raise BadInput(f"{where}: its last row is {matrix[3].tolist()}, expected 0 0 0 1.{hint}")
    rotation = matrix[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
        raise BadInput(f"{where}: its upper left 3x3 is no rotation (determinant {np.linalg.det(rotation):.4g}).")
    u, _, vt = np.linalg.svd(rotation)
    matrix[:3, :3] = u @ vt
    return pose_from_opengl(matrix)


def _number(value: Any, where: str, expected: str, low: float, high: float) -> float:
    """A finite number strictly between low and high."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not low < value < high:
        raise BadInput(f"{where}: found {_shown(value)}, expected {expected}.")
    return float(value)


def _shown(value: Any) -> str:
    if isinstance(value, list):
        return f"a list of {len(value)}"
    return "nothing" if value is None else repr(value)[:40]


@dataclass(frozen=True)
class RenderOptions:
    """How a path is drawn.

    background   white, black, transparent or #rrggbb; with transparent the PNG carry alpha and the video lies on white
    supersample  rays along each side of a pixel
    exr          "off", "first" or "all": which frames are written as EXR too
    video        name of the MP4 in the output folder, or None
    fps, crf     of the video
    """

    background: str = "white"
    supersample: int = 1
    exr: str = "first"
    video: str | None = "turntable.mp4"
    fps: int = 30
    crf: int = 18


Progress = Callable[[int, int], None]


def draw_frames(
    tree: NerfTree, cameras: Sequence[Camera], folder: Path, options: RenderOptions, progress: Progress | None = None, *, reuse: bool = False,
    draw: Callable[..., Rendering] | None = None,
) -> list[Path]:
    """Draw frame_0000.png ... (and .exr) into a folder; returns the files in order.

    progress  called with frames done and their number before each and at the end; may raise to stop
    reuse     keep frames that are there: only for a folder that nothing but this very request has written
    draw      `efficientnerf.asset.rendering.render`, unless another is given
    """
    from efficientnerf.asset.rendering import render
    from stages.io.exporters.exr import write_exr
    from stages.io.exporters.frames import background_from_text, frame_from_rendering
    from stages.io.png import write_png

    background, similarity = background_from_text(options.background), similarity_of(tree)
    draw = draw or render
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for k, camera in enumerate(cameras):
        if progress is not None:
            progress(k, len(cameras))
        png, exr = folder / f"frame_{k:04d}.png", folder / f"frame_{k:04d}.exr"
        with_exr = options.exr == "all" or (options.exr == "first" and k == 0)
        # The PNG comes last and appears whole: where it stands, the frame is finished.
        if not (reuse and png.exists()):
            seen = draw(tree, camera, supersample=options.supersample)
            if with_exr:
                write_exr(exr, colour=seen.colour, opacity=seen.opacity, depth=seen.depth, normal=seen.normal, world_from_capture=similarity)
            write_png(frame_from_rendering(seen.colour, seen.opacity, background), png)
        written += [png, exr] if with_exr else [png]
    if progress is not None:
        progress(len(cameras), len(cameras))
    return written


def encode_frames(frames: Sequence[Path], path: Path, options: RenderOptions, each: Callable[[], None] | None = None) -> None:
    """The PNGs as an MP4."""
    from stages.io.exporters.frames import NAMED, over_background
    from stages.io.exporters.video import write_mp4
    from stages.io.png import read_png

    write_mp4((over_background(read_png(frame), NAMED["white"]) for frame in frames), path, fps=options.fps, crf=options.crf, each=each)


def render_path(
    tree: NerfTree, cameras: Sequence[Camera], out_dir: Path, options: RenderOptions, progress: Progress | None = None,
    draw: Callable[..., Rendering] | None = None,
) -> list[Path]:
    """Draw a path into a folder: PNG frames, EXR as asked, and the video; returns the files. Frames of the same names are overwritten."""
    written = draw_frames(tree, cameras, out_dir, options, progress, draw=draw)
    if options.video is not None:
        video = out_dir / options.video
        encode_frames([path for path in written if path.suffix == ".png"], video, options)
        written.append(video)
    return written
