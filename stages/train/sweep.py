"""The plane that a subject stands on, as training views of a scene show it where sparse points do not."""

from collections.abc import Callable

import cv2
import numpy as np

from efficientnerf.capture.plane_sweep import SweptPlane, picture_of, swept_plane
from efficientnerf.training.pixels import Pixels
from stages.io.scene import Scene, View

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
