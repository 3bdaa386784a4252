"""A patterned cube that turns before a patterned wall, as a camera on a stand sees it: in the cube's frame the camera goes round."""

import cv2
import numpy as np

from benchmarks.scenes.room import TEXTURE, pattern
from efficientnerf.geometry.cameras import Camera, rays
from tests.poses import looking_at

WIDTH, HEIGHT, FOCAL = 320, 240, 420.0
HALF = np.array([0.5, 0.4, 0.55])


def cameras(count: int, degrees: float = 360.0) -> list[Camera]:
    """Round the cube, or a part of the way, 25 degrees above it."""
    made = []
    for n in range(count):
        angle = np.radians(degrees) * n / count
        centre = 3.4 * np.array([np.cos(angle) * 0.9, np.sin(angle) * 0.9, 0.42])
        made.append(Camera(f"{n:02d}.png", WIDTH, HEIGHT, "SIMPLE_PINHOLE", (FOCAL, WIDTH / 2, HEIGHT / 2), looking_at(centre)))
    return made


def wall_picture() -> np.ndarray:
    """(HEIGHT, WIDTH, 3) float."""
    return np.asarray(cv2.resize(pattern(90), (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA), np.float64)


def picture(camera: Camera, seed: int, *, wall: np.ndarray | None = None, wall_moves: bool = False, supersample: int = 2) -> np.ndarray:
    """(HEIGHT, WIDTH, 3) uint8, with noise of 1.5 levels.

    wall_moves  whether it is elsewhere in each picture, as before a camera that moves
    """
    steps = (np.arange(supersample) + 0.5) / supersample
    y, x = np.meshgrid((np.arange(HEIGHT)[:, None] + steps).ravel(), (np.arange(WIDTH)[:, None] + steps).ravel(), indexing="ij")
    origins, directions = rays(camera, np.stack([x.ravel(), y.ravel()], -1))
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = ((sign * HALF - origins) / directions for sign in (-1, 1))
    entry, exit_ = np.minimum(low, high).max(1), np.maximum(low, high).min(1)
    hit = entry <= exit_
    axis = np.minimum(low, high).argmax(1)
    at = origins + np.where(hit, entry, 0)[:, None] * directions
    behind = wall_picture() if wall is None else wall
    behind = np.roll(behind, 23 * seed, axis=1) if wall_moves else behind
    colour = np.repeat(np.repeat(behind, supersample, 0), supersample, 1).reshape(-1, 3).copy()
    for side in range(3):
        on = [((at[:, k] / HALF.max() + 1) * TEXTURE / 2 - 0.5).astype(np.float32).reshape(y.shape) for k in range(3) if k != side]
        for sign in (-1, 1):
            here = hit & (axis == side) & (np.sign(at[:, side]) == sign)
            if here.any():
                colour[here] = cv2.remap(pattern(50 + 2 * side + (sign > 0)), *on, cv2.INTER_LINEAR).reshape(-1, 3)[here]
    mean = colour.reshape(HEIGHT, supersample, WIDTH, supersample, 3).mean((1, 3))
    return np.asarray(np.clip(np.rint(mean + np.random.default_rng(seed).normal(0, 1.5, mean.shape)), 0, 255), np.uint8)
