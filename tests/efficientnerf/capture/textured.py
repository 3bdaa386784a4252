"""Photographs of a textured floor with a wall behind it, along an arc."""

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from efficientnerf.geometry.cameras import Camera, project, rays
from tests.poses import looking_at

WIDTH, HEIGHT = 120, 96
WALL = 1.5  # y of a wall behind the floor, z = 0
PARALLAX = 0.16  # what a pixel from one photograph to the next means along the axis, about


def cameras(count: int = 4) -> list[Camera]:
    """Along an arc of eight degrees each, through a lens that distorts."""
    found = []
    for turn in np.radians(8) * (np.arange(count) - (count - 1) / 2):
        pose = looking_at(3 * np.array([np.sin(turn), -np.cos(turn), 0.7]), (0, 0.2, 0.1))
        found.append(Camera(f"{turn:.2f}", WIDTH, HEIGHT, "SIMPLE_RADIAL", (150.0, WIDTH / 2, HEIGHT / 2, -0.1), pose))
    return found


def photograph(camera: Camera, contrast: float = 30.0) -> np.ndarray:
    """Of a floor with a wall behind it, both with a random pattern on a gradient."""
    pattern = gaussian_filter(np.random.default_rng(0).normal(size=(2, 500, 500)), (0, 2.0, 2.0))
    pattern *= contrast / pattern.std()
    origins, directions = (array.reshape(-1, 3) for array in rays(camera))
    floor, wall = -origins[:, 2] / directions[:, 2], (WALL - origins[:, 1]) / directions[:, 1]
    on_floor = (floor > 0) & (floor < wall)
    at = origins + np.where(on_floor, floor, wall)[:, None] * directions
    across = np.stack([at[:, 0], np.where(on_floor, at[:, 1], at[:, 2])]) * 100 + 250
    values = [map_coordinates(part, across, order=1, mode="reflect") for part in pattern]
    return np.clip(120 + 20 * at[:, 0] + np.where(on_floor, *values), 0, 255).astype(np.uint8).reshape(HEIGHT, WIDTH)


def sparse(made: list[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Points on the floor alone, and which cameras see them."""
    x, y = np.meshgrid(np.linspace(-0.8, 0.8, 6), np.linspace(-0.8, 1, 5))
    xyz = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)
    inside = []
    for camera in made:
        at, depth = project(camera, xyz)
        inside.append((depth > 0) & (at > 0).all(1) & (at < (WIDTH, HEIGHT)).all(1))
    return xyz, np.array(inside)


def off(points: np.ndarray) -> np.ndarray:
    """How far points are from the nearer of the two surfaces."""
    return np.minimum(np.abs(points[:, 2]), np.abs(points[:, 1] - WALL))
