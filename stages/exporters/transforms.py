"""Cameras as nerfstudio's transforms.json: camera to world with x right, y up, looking along -z, in the capture's frame; intrinsics in
pixels of the source images."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from efficientnerf.cameras import Camera, opengl_from_pose
from pipeline.errors import BadInput
from stages.scene import SPLITS, Scene, views_of

from .writing import write_aside

# What COLMAP's models are called there; its OPENCV has k1 to k4 as coefficients of a polynomial in the squared radius.
_MODELS = {
    "SIMPLE_PINHOLE": "PINHOLE",
    "PINHOLE": "PINHOLE",
    "SIMPLE_RADIAL": "OPENCV",
    "RADIAL": "OPENCV",
    "OPENCV": "OPENCV",
    "FULL_OPENCV": "OPENCV",
    "OPENCV_FISHEYE": "OPENCV_FISHEYE",
}
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")


def write_cameras(scene: Scene, path: Path, images: Path | None = None) -> int:
    """Write the scene's source cameras; returns how many.

    images  folder that the names of the views are relative to; None: the names are written as they are

    Raises BadInput for a lens that the format cannot hold.
    """
    frames, models = [], set()
    for view in scene.views:
        lens = _lens(view.source_camera, path)
        models.add(lens.pop("camera_model"))
        name = view.name if images is None else Path(os.path.relpath(images / view.name, path.parent)).as_posix()
        frames.append({"file_path": name, **lens, "transform_matrix": opengl_from_pose(view.source_camera.world_from_camera).tolist()})
    if len(models) > 1:
        raise BadInput(f"{path}: the cameras are of the kinds {', '.join(sorted(models))}; transforms.json holds one.")
    shared = {name: value for name, value in frames[0].items() if all(frame.get(name) == value for frame in frames)} if len(frames) > 1 else {}
    own = [{name: value for name, value in frame.items() if name not in shared} for frame in frames]
    document: dict[str, Any] = {"camera_model": models.pop(), **shared}
    paths = {view.name: frame["file_path"] for view, frame in zip(scene.views, frames, strict=True)}
    document |= {f"{split}_filenames": [paths[view.name] for view in views_of(scene, split)] for split in SPLITS}
    document["frames"] = own
    write_aside(path, [(json.dumps(document, indent=1, allow_nan=False) + "\n").encode()])
    return len(frames)


def _lens(camera: Camera, path: Path) -> dict[str, Any]:
    """Size, intrinsics and distortion under the names of the format."""
    known = camera.intrinsics
    lens: dict[str, Any] = {"camera_model": _MODELS[camera.model], "w": camera.width, "h": camera.height}
    lens |= {"fl_x": known["fx"], "fl_y": known["fy"], "cx": known["cx"], "cy": known["cy"]}
    if camera.model == "FULL_OPENCV" and any(known.get(name) for name in ("k4", "k5", "k6")):
        raise BadInput(f"{path}: {camera.name}: FULL_OPENCV with k4 to k6, which transforms.json cannot hold. Undistort the images first.")
    for name in _COEFFICIENTS:
        value = known.get(name, 0.0)
        if value:
            lens[name] = value
    return lens
