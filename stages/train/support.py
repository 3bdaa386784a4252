"""The planes that support a subject: as training views show them, and support.json, by which later stages know them."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import cv2
import msgspec
import numpy as np

from efficientnerf.capture.plane_sweep import SweptPlane, picture_of, swept_plane, swept_wall, wall_faces
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


def find_planes(
    s: Scene, pixels: Pixels, views: tuple[View, ...], points: np.ndarray, seed: int, progress: Callable[[float], None]
) -> list[SweptPlane]:
    """What `efficientnerf.capture.plane_sweep` finds below and behind a subject of sparse points (N, 3).

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
    found = [swept_plane(pictures, points, seed, lambda share: progress(share / 2))]
    if (faces := wall_faces([view.camera for view in trained], points)) is not None:
        found.append(swept_wall(pictures, points, faces, seed, lambda share: progress((1 + share) / 2)))
    return [plane for plane in found if plane is not None]


class _Plane(msgspec.Struct):
    normal: Vector  # of unit length, towards the subject
    offset: Number

    def __post_init__(self) -> None:
        if not math.isclose(math.hypot(*self.normal), 1, rel_tol=1e-6):
            raise ValueError("a normal that is not of unit length")


class _Document(msgspec.Struct):
    format: Literal[1]
    planes: list[_Plane]


def write(planes: Sequence[Plane], path: Path) -> None:
    """Write support.json; where there is no plane, remove it."""
    if planes:
        write_json(path, {"format": FORMAT, "planes": [{"normal": normal.tolist(), "offset": offset} for normal, offset in planes]})
    else:
        remove(path)


def load(train: Path) -> tuple[Plane, ...]:
    """The planes that support the subject, in the training frame, as the train stage in a folder knew them. Raises CorruptArtifact."""
    path = TrainOutputs(train).support
    if not path.is_file():
        return ()
    return tuple((np.asarray(plane.normal, np.float64), float(plane.offset)) for plane in read_document(path, _Document, REMEDY).planes)
