"""The plane that a subject stands on: as training views show it where sparse points do not, and support.json, by which later stages know it."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import cv2
import msgspec
import numpy as np

from efficientnerf.capture.plane_sweep import SweptPlane, picture_of, swept_plane
from efficientnerf.capture.supports import Plane
from efficientnerf.geometry.orbit import Number, Vector
from efficientnerf.training.pixels import Pixels
from pipeline.files import remove, write_json
from stages.artifacts import TrainOutputs
from stages.io.scene import Scene, View
from stages.io.scene_schema import read_document

FORMAT = 1
REMEDY = "Train again."

MOST_PHOTOGRAPHS = 60  # that are compared: of more, evenly chosen ones


def find_plane(s: Scene, pixels: Pixels, views: tuple[View, ...], points: np.ndarray, seed: int, progress: Callable[[float], None]) -> SweptPlane | None:
    """What `efficientnerf.capture.plane_sweep` finds below a subject of sparse points (N, 3).

    pixels, views  of the scene, whose cameras may be others by now
    progress       gets the share that is done; what it raises stops the search
    """
    trained = [view for view in s.views if view.split == "train"]
    trained = [trained[number] for number in np.linspace(0, len(trained) - 1, min(len(trained), MOST_PHOTOGRAPHS)).round().astype(int)]
    rows = {view.image: number for number, view in enumerate(views)}
    pictures = []
    for view in trained:
        row, shape = rows[view.image], (view.camera.height, view.camera.width)
        image = np.asarray(pixels.images[int(pixels.offsets[row]) : int(pixels.offsets[row + 1])]).reshape(*shape, -1)
        usable = pixels.usable_of(row) & (image[..., 3] > 127 if image.shape[-1] == 4 else True)
        pictures.append(picture_of(cv2.cvtColor(np.ascontiguousarray(image[..., :3]), cv2.COLOR_RGB2GRAY), usable, view.camera, points))
    return swept_plane(pictures, points, seed, progress)


class _Document(msgspec.Struct):
    format: Literal[1]
    normal: Vector  # of unit length, towards the cameras
    offset: Number


def write(plane: Plane | None, path: Path) -> None:
    """Write support.json; where there is no plane, remove it."""
    if plane is None:
        remove(path)
    else:
        write_json(path, {"format": FORMAT, "normal": plane[0].tolist(), "offset": plane[1]})


def load(train: Path) -> Plane | None:
    """The plane that the subject stands on, in the training frame, as the train stage in a folder knew it; None: it knew none. Raises CorruptArtifact."""
    path = TrainOutputs(train).support
    if not path.is_file():
        return None
    found = read_document(path, _Document, REMEDY)
    return np.asarray(found.normal, np.float64), float(found.offset)
