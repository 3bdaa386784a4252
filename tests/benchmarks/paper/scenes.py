"""Scenes that tables are made on."""

import json
import math
from pathlib import Path

from tests.efficientnerf.balls import cameras, picture
from tests.stages.captures import write_picture


def ball(folder: Path) -> Path:
    """A Blender data set of the analytic ball: 8 views to train on, 2 to test on."""
    for split, some in (("train", cameras(8, 48)), ("test", cameras(10, 48)[8:])):
        frames = []
        for n, camera in enumerate(some):
            write_picture(folder / split / f"{n}.png", picture(camera))
            pose = camera.world_from_camera.copy()
            pose[:3, 1:3] *= -1  # Blender's cameras look along -z
            frames.append({"file_path": f"./{split}/{n}", "transform_matrix": pose.tolist()})
        document = {"camera_angle_x": 2 * math.atan(24 / (1.3 * 48)), "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(document))
    return folder
