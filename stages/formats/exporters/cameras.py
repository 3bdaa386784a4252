"""Cameras for other programs: nerfstudio's transforms.json, in the capture's frame.

What is written are the cameras of the source images (after EXIF rotation) with their distortion, as found or as read; the file belongs
into the folder of the source images, whose names it uses.
"""

from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.geometry.cameras import Camera, opengl_from_pose
from pipeline.files import write_json
from stages.formats.exporters.writing import SourceFrame
from stages.io.scene import SPLITS, Scene, views_of

# nerfstudio knows these; any other is written as the one that contains it.
_WRITTEN_AS = {"SIMPLE_PINHOLE": "PINHOLE", "SIMPLE_RADIAL": "OPENCV", "RADIAL": "OPENCV"}
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


def transforms_from_scene(scene: Scene, up: np.ndarray | None = None) -> dict[str, Any]:
    """The document of a transforms.json: x right, y up, looking along -z, camera to the capture's frame.

    Intrinsics that all cameras share stand at the top, else in each frame. A FULL_OPENCV lens keeps that name, which nerfstudio does not
    know: no model of its own contains it.
    """
    lenses = [_lens(view.source_camera) for view in scene.views]
    shared = lenses[0] if lenses and all(lens == lenses[0] for lens in lenses) else {}
    frames = []
    for view, lens in zip(scene.views, lenses, strict=True):
        frame: dict[str, Any] = {"file_path": view.name} | ({} if shared else lens)
        frame["transform_matrix"] = opengl_from_pose(view.source_camera.world_from_camera).tolist()
        frames.append(frame)
    splits = {f"{split}_filenames": [view.name for view in views_of(scene, split)] for split in SPLITS}
    of_capture = SourceFrame(scene.world_from_capture, scene.metric, up)
    stated = {"unit": of_capture.unit, "up": (of_capture.up + 0.0).tolist()}  # which nerfstudio passes over
    return shared | stated | {name: names for name, names in splits.items() if names} | {"frames": frames}


def write(scene: Scene, path: Path, up: np.ndarray | None = None) -> None:
    """Write transforms.json for a scene, atomically; `up` as of SourceFrame."""
    write_json(path, transforms_from_scene(scene, up))


def _lens(camera: Camera) -> dict[str, Any]:
    named = camera.intrinsics
    model = _WRITTEN_AS.get(camera.model, camera.model)
    lens: dict[str, Any] = {"camera_model": model, "w": camera.width, "h": camera.height}
    lens |= {"fl_x": named["fx"], "fl_y": named["fy"], "cx": named["cx"], "cy": named["cy"]}
    wanted = {"PINHOLE": (), "OPENCV": ("k1", "k2", "p1", "p2"), "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4")}.get(model, _DISTORTION)
    return lens | {key: named[key] for key in wanted}
