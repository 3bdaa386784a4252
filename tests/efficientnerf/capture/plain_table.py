"""Photographs of a table with a faint grain, all round a subject that stands on it."""

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from efficientnerf.geometry.cameras import Camera, rays
from tests.poses import looking_at

WIDTH, HEIGHT = 160, 120
NORMAL, LEVEL = np.array([-0.04, 0.02, 1.0]), -0.3  # of the table, and z where x and y are 0


def cameras(count: int = 24) -> list[Camera]:
    """In a circle, through a lens that distorts."""
    lens = (190.0, WIDTH / 2, HEIGHT / 2, -0.05)
    turns = np.arange(count) * 2 * np.pi / count
    poses = [looking_at((3 * np.cos(a), 3 * np.sin(a), 1.5 + 0.3 * np.sin(5 * a)), (0, 0, -0.1)) for a in turns]
    return [Camera(f"{a:.2f}", WIDTH, HEIGHT, "SIMPLE_RADIAL", lens, pose) for a, pose in zip(turns, poses, strict=True)]


def photograph(camera: Camera, seed: int = 0, level: float = LEVEL, grain: float = 4.0) -> np.ndarray:
    """(H, W) uint8: the table, with noise of one level, darker to one side."""
    pattern = gaussian_filter(np.random.default_rng(seed).normal(size=(600, 600)), 1.5)
    origins, directions = (array.reshape(-1, 3) for array in rays(camera))
    distance = ((0, 0, level) @ NORMAL - origins @ NORMAL) / (directions @ NORMAL)
    at = origins + distance[:, None] * directions
    value = map_coordinates(pattern * grain / pattern.std(), at[:, :2].T * 60 + 300, order=1, mode="reflect")
    noise = np.random.default_rng(round(1000 * float(camera.name))).normal(size=value.shape)
    shown = np.where(distance > 0, 150 + 30 * directions[:, 0] + value, 90) + noise
    return np.asarray(np.clip(shown, 0, 255).round().astype(np.uint8).reshape(HEIGHT, WIDTH))


def subject() -> np.ndarray:
    """(N, 3) sparse points of what stands on it."""
    rng = np.random.default_rng(1)
    return np.column_stack([rng.uniform(-0.25, 0.25, (400, 2)), rng.uniform(LEVEL, 0.25, 400)])


def height(points: np.ndarray) -> np.ndarray:
    """How far points are above the table."""
    return np.asarray((points - (0, 0, LEVEL)) @ NORMAL / np.linalg.norm(NORMAL))
