"""A room with patterned walls, as any lens sees it from inside: what a fisheye lens needs, whose picture holds half of all directions."""

from functools import cache
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from efficientnerf.geometry.cameras import Camera, rays
from tests.poses import looking_at

HALF = np.array([2.4, 1.8, 1.3])  # of the room, from its middle
PILLARS = ((0.1, -0.1, 0.16), (-1.8, 1.1, 0.25), (1.8, -1.2, 0.2))  # x, y, half side
TEXTURE = 768  # px, side of a wall's pattern


@cache
def pattern(seed: int) -> np.ndarray:
    """(TEXTURE, TEXTURE, 3) float32 of blots of several sizes."""
    rng = np.random.default_rng(seed)
    layers = [cv2.resize(rng.uniform(0, 255, (n, n, 3)).astype(np.float32), (TEXTURE, TEXTURE), interpolation=cv2.INTER_CUBIC) for n in (7, 24, 70)]
    return np.asarray(np.clip((layers[0] + layers[1] + 1.5 * layers[2]) / 3.5, 0, 255), np.float32)


def picture(camera: Camera, supersample: int = 2) -> np.ndarray:
    """(H, W, 3) uint8 of the room."""
    steps = (np.arange(supersample) + 0.5) / supersample
    y, x = np.meshgrid((np.arange(camera.height)[:, None] + steps).ravel(), (np.arange(camera.width)[:, None] + steps).ravel(), indexing="ij")
    origins, directions = rays(camera, np.stack([x.ravel(), y.ravel()], -1))
    nearest, colour = np.full(len(origins), np.inf), np.zeros((len(origins), 3), np.float32)
    boxes = [(np.zeros(3), HALF, True)] + [(np.array([x, y, 0.0]), np.array([side, side, HALF[2]]), False) for x, y, side in PILLARS]
    with np.errstate(divide="ignore", invalid="ignore"):
        for number, (middle, half, inside) in enumerate(boxes):
            low, high = ((sign * half + middle - origins) / directions for sign in (-1, 1))
            entry, exit_ = np.minimum(low, high).max(1), np.maximum(low, high).min(1)
            axis = np.maximum(low, high).argmin(1) if inside else np.minimum(low, high).argmax(1)
            distance = exit_ if inside else entry
            hit = (distance > 0) & (entry <= exit_) & (distance < nearest)
            at = origins + distance[:, None] * directions - middle
            for side in range(3):
                on = [((at[:, k] / HALF.max() + 1) * TEXTURE / 2 - 0.5).astype(np.float32).reshape(y.shape) for k in range(3) if k != side]
                for sign in (-1, 1):
                    here = hit & (axis == side) & (np.sign(at[:, side]) == sign)
                    if here.any():
                        wall = cv2.remap(pattern(6 * number + 2 * side + (sign > 0)), *on, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
                        colour[here] = wall.reshape(-1, 3)[here]
            nearest[hit] = distance[hit]
    mean = colour.reshape(camera.height, supersample, camera.width, supersample, 3).mean((1, 3))
    return np.asarray(np.rint(mean), np.uint8)


def cameras(count: int, width: int, height: int, model: str, params: tuple[float, ...]) -> list[Camera]:
    """On a circle in the room, looking over its middle and up and down by turns."""
    made = []
    for n in range(count):
        angle = 2 * np.pi * n / count
        centre = np.array([0.9 * np.cos(angle), 0.7 * np.sin(angle), 0.35 * np.sin(2.3 * n)])
        forward = np.array([-np.cos(angle + 0.4 * np.sin(n)), -np.sin(angle + 0.4 * np.sin(n)), 0.25 * np.cos(1.7 * n)])
        pose = looking_at((0, 0, 0), forward)
        pose[:3, 3] = centre
        made.append(Camera(f"room_{n:02d}.jpg", width, height, model, params, pose))
    return made


def write(folder: Path, made: list[Camera], lens: str | None = None) -> Path:
    """JPEGs of the room, with the name of the lens in their EXIF data."""
    folder.mkdir(parents=True, exist_ok=True)
    for camera in made:
        exif = Image.Exif()
        if lens:
            exif.get_ifd(34665)[42036] = lens
        Image.fromarray(picture(camera)).save(folder / camera.name, quality=95, exif=exif)
    return folder
