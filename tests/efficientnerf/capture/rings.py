"""Cameras that stand round the origin."""

import numpy as np

from efficientnerf.geometry.cameras import Camera
from tests.poses import looking_at


def cameras_round(count: int, rng: np.random.Generator, model: str = "OPENCV") -> list[Camera]:
    found = []
    for index, angle in enumerate(np.linspace(0.0, 2.5, count)):
        centre = np.array([3 * np.cos(angle), 3 * np.sin(angle), rng.uniform(1.5, 2.5)])
        pose = looking_at(centre)
        params = (1500.0, 1510.0, 800.0, 600.0, -0.1, 0.02, 1e-3, -1e-3) if model == "OPENCV" else (1500.0, 1500.0, 800.0, 600.0, 0.01, 0.0, 0.0, 0.0)
        found.append(Camera(f"{index}.png", 1600, 1200, model, params, pose))
    return found
