"""nerfstudio's camera_path.json: the cameras of a video, one for each frame."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.geometry.cameras import Camera, Similarity, pose_from_opengl
from pipeline.errors import BadInput
from stages.formats.importers.lenses import rigid
from stages.io.json_file import finite, numbers, read_json, shown

MAX_FILE = 64 << 20
MAX_SIZE = 16384
MAX_PIXELS = 2**27  # that `efficientnerf.asset.rendering` renders at once, which a test compares
MAX_CAMERAS = 100_000
MIN_ANGLE = 1e-3  # degrees


@dataclass(frozen=True, eq=False)
class CameraPath:
    """Cameras in the training frame, one for each frame, and the frames per second that the file asks for (None: it does not say)."""

    cameras: tuple[Camera, ...]
    fps: int | None


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
        raise BadInput(f"{path}: camera_type {shown(kind)}; only perspective paths can be drawn.")
    entries = document["camera_path"]
    if not 1 <= len(entries) <= MAX_CAMERAS:
        raise BadInput(f"{path}: camera_path holds {len(entries)} cameras; expected 1 to {MAX_CAMERAS}.")
    size = _size(document, path, width, height)
    if size[0] * size[1] > MAX_PIXELS:
        raise BadInput(f"{path}: pictures of {size[0]} x {size[1]} pixels; expected at most {MAX_PIXELS} pixels. Give --width and --height.")
    cameras = []
    for k, entry in enumerate(entries):
        where = f"{path}: camera_path[{k}]"
        if not isinstance(entry, dict):
            raise BadInput(f"{where}: expected an object, found {shown(entry)}.")
        matrix = np.reshape(numbers(entry.get("camera_to_world"), 16, f"{where}.camera_to_world", "Export the path again."), (4, 4))
        pose = world_from_capture.pose(pose_from_opengl(rigid(matrix, f"{where}.camera_to_world")))
        vertical = _number(entry.get("fov", document.get("default_fov")), f"{where}.fov", "degrees between 0 and 180", MIN_ANGLE, 180.0 - MIN_ANGLE)
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


def _number(value: Any, where: str, expected: str, low: float, high: float) -> float:
    """A finite number strictly between low and high."""
    number = finite(value)
    if number is None or not low < number < high:
        raise BadInput(f"{where}: found {shown(value)}, expected {expected}.")
    return number
