"""A ball with a closed form as a scene to learn: cameras round it, its images, and its models."""

import math

import numpy as np

from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.geometry.spaces import space_from
from efficientnerf.model import Model, model
from efficientnerf.training.pixels import Pixels
from efficientnerf.training.settings import TrainSettings

BOUNDS = np.array([[-1.0] * 3, [1.0] * 3])
CENTRE, RADIUS, SIGMA = np.array([0.1, -0.05, 0.0]), 0.55, 30.0
SMALL = {
    "num_levels": 4, "log2_hashmap_size": 11, "finest_resolution": 64, "hidden_dim": 16, "num_layers": 1, "coarse_hidden_dim": 16,
    "coarse_num_layers": 1, "sh_degree": 1, "occupancy_resolution": 24, "num_coarse_samples": 16, "samples_per_pivot": 2,
    "sample_batch_size": 6144, "occupancy_warmup_steps": 20, "occupancy_update_interval": 4, "checkpoint_every": 10, "preview_every": "off",
    "learning_rate": 3e-2, "iterations": 60,
}  # fmt: skip


def pose(azimuth: float, elevation: float, distance: float = 3.0) -> np.ndarray:
    """Camera to world, looking at the origin; angles in radians."""
    back = np.array([math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)])
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    out = np.eye(4)
    out[:3, 0], out[:3, 1], out[:3, 2], out[:3, 3] = right, -np.cross(back, right), -back, distance * back
    return out


def cameras(count: int = 8, side: int = 16) -> list[Camera]:
    lens = (1.3 * side, side / 2, side / 2)
    return [Camera(f"v{n:02}.png", side, side, "SIMPLE_PINHOLE", lens, pose(2.4 * n, 0.5 * math.sin(1.7 * n))) for n in range(count)]


def picture(camera: Camera, radius: float = RADIUS) -> np.ndarray:
    """(H, W, 4) uint8, straight alpha: opacity 1 - exp(-sigma chord), colour from where the ray enters."""
    origins, directions = rays(camera)
    middle = ((CENTRE - origins) * directions).sum(-1)
    chord = np.sqrt(np.maximum(radius**2 - ((CENTRE - origins) ** 2).sum(-1) + middle**2, 0))
    hit = origins + (middle - chord)[:, None] * directions
    colour = np.clip(0.5 + 0.6 * (hit - CENTRE), 0, 1)
    rgba = np.concatenate([colour, 1 - np.exp(-2 * SIGMA * chord)[:, None]], axis=1)
    return np.round(255 * rgba).astype(np.uint8).reshape(camera.height, camera.width, 4)


def photograph(camera: Camera) -> np.ndarray:
    """(H, W, 3) uint8: the ball before a background whose colour is a smooth function of the direction."""
    rgba = picture(camera) / 255
    behind = (0.5 + 0.4 * np.sin(2 * rays(camera)[1])).reshape(camera.height, camera.width, 3)
    return np.round(255 * (rgba[..., :3] * rgba[..., 3:] + behind * (1 - rgba[..., 3:]))).astype(np.uint8)


def pixels(count: int = 8, side: int = 16, radius: float = RADIUS) -> Pixels:
    """Training pixels of the ball."""
    made = cameras(count, side)
    return Pixels(made, [picture(c, radius) for c in made], [None] * count, np.full(count, 1.0), np.full(count, 5.0))


def settings(**changes: object) -> TrainSettings:
    return TrainSettings(**{**SMALL, **changes})  # type: ignore[arg-type]


def untrained(*, contracted: bool = False, background: tuple[float, float, float] | None = (1.0, 1.0, 1.0), **changes: object) -> Model:
    return model(space_from(BOUNDS, contracted=contracted), settings(**changes), None if contracted else background)
