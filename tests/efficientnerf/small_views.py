"""Three small views of different sizes."""

import numpy as np

from efficientnerf.geometry.cameras import Camera
from efficientnerf.training.pixels import Pixels

SIZES = [(7, 5), (4, 9), (1, 3)]  # width, height


def views(masks: list[np.ndarray | None] | None = None) -> Pixels:
    cameras = [Camera(f"{n}.png", w, h, "SIMPLE_PINHOLE", (9.0, w / 2, h / 2), np.eye(4)) for n, (w, h) in enumerate(SIZES)]
    images = [np.zeros((h, w, 3), np.uint8) for w, h in SIZES]
    return Pixels(cameras, images, masks or [None] * 3, np.ones(3), np.full(3, 2.0))
