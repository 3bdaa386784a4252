"""A scene with surroundings as a field in closed form: a ball on the ground, a wall far round it, and the sky above that."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from efficientnerf.fields.field import BakeableField
from efficientnerf.geometry.cameras import Camera
from efficientnerf.geometry.spaces import Space
from efficientnerf.model import Model
from efficientnerf.rendering.field_renderer import FieldRenderer
from tests.efficientnerf.balls import pose, untrained

RADIUS, GROUND, WALL, TOP = 0.4, -0.4, 5.0, 2.5  # of the ball; height of the ground; distance and height of the wall


class Surroundings(BakeableField):
    """Densities are per contracted unit beyond the box, as networks learn them. Harmonics of degree 0: the colour is a function of the place."""

    activation = "softplus"
    degree = 0

    def __init__(self, space: Space) -> None:
        super().__init__()
        self.space = space

    def forward(self, points: Tensor) -> Tensor:
        world = self.space.world(points)
        plan = world[:, :2].norm(dim=1)
        ball = world.norm(dim=1) < RADIUS
        ground = (world[:, 2] < GROUND) & (world[:, 2] > GROUND - 0.25) & (plan < WALL + 0.5)
        wall = (plan > WALL) & (plan < WALL + 1.0) & (world[:, 2] < TOP) & (world[:, 2] > GROUND)
        growth = self.space.unit(world).abs().amax(dim=1).clamp(min=1) ** 2
        density = torch.where(ball | ground, 60.0, torch.where(wall, 12.0, 0.0)) * growth
        colour = torch.stack([torch.where(ball, 2.0, -1.0), torch.sin(2 * torch.atan2(world[:, 1], world[:, 0])), torch.where(wall, 1.5, -0.5)], dim=1)
        return torch.cat([torch.where(density > 0, density + 1, torch.full_like(density, -20.0))[:, None], colour / 0.2820948], dim=1)


def surroundings(**changes: Any) -> Model:
    m = untrained(contracted=True, num_coarse_samples=128, samples_per_pivot=4, max_pivots=16, **changes)
    m.coarse, m.fine = Surroundings(m.space), Surroundings(m.space)
    with torch.no_grad():
        m.sky.sh[0] = torch.tensor([-1.0, 0.5, 2.0]) / 0.2820948
    return m


def around(count: int = 10, side: int = 32) -> list[Camera]:
    """Cameras round the ball, that look at it and past it."""
    lens = (0.8 * side, side / 2, side / 2)
    return [Camera(f"v{n:02}.png", side, side, "SIMPLE_PINHOLE", lens, pose(2 * np.pi * n / count, 0.15 + 0.2 * (n % 2), 1.7)) for n in range(count)]


def photographs(m: Model, cameras: list[Camera]) -> list[np.ndarray]:
    """What cameras take of the field, (H, W, 3) uint8."""
    renderer = FieldRenderer(m, 0.2, 60.0)
    return [np.round(255 * renderer.render(camera).colour.clip(0, 1)).astype(np.uint8) for camera in cameras]
