"""Scenes that a seed draws: shapes, textures, light and cameras, for networks that are trained over many. All lie within 1.05 of MIDDLE along each axis."""

import numpy as np

from benchmarks.scenes.catalogue import Recipe, dome
from benchmarks.scenes.shapes import Box, Capsule, Disc, Material, Shape, Sphere, point

MIDDLE = (0.0, 0.0, 0.45)
PATTERNS = ("noise", "noise", "checks", "stripes", "plain")


def drawn(seed: int) -> Recipe:
    """The scene of a seed: 4 to 12 shapes, most of them on a slab, under a sun of its own."""
    rng = np.random.default_rng([40, seed])
    shapes = [_shape(rng) for _ in range(rng.integers(4, 13))]
    if rng.random() < 0.7:
        width = rng.uniform(0.45, 0.65)
        shapes.append(Box((0.0, 0.0, -0.02), (width, rng.uniform(0.45, 0.65), 0.03), _material(rng), heading=rng.uniform(0, 90)))
    azimuth, height = rng.uniform(0, 2 * np.pi), rng.uniform(0.35, 0.95)
    sun = (np.sqrt(1 - height**2) * np.cos(azimuth), np.sqrt(1 - height**2) * np.sin(azimuth), height)
    place = dome(rng.uniform(2.7, 3.6), rng.uniform(-25, 5), rng.uniform(55, 80), MIDDLE)
    return Recipe(tuple(shapes), True, place, rng.uniform(1.2, 1.5), sun=sun)


def _shape(rng: np.random.Generator) -> Shape:
    """One shape within 0.6 of the axis."""
    angle, away = rng.uniform(0, 2 * np.pi), 0.6 * np.sqrt(rng.random())
    at = point(away * np.cos(angle), away * np.sin(angle), rng.uniform(0.05, 0.75))
    material, kind = _material(rng), rng.integers(4)
    if kind == 0:
        return Sphere(at, rng.uniform(0.08, 0.28), material)
    if kind == 1:
        return Box(at, point(*rng.uniform(0.05, 0.25, 3)), material, heading=rng.uniform(0, 90))
    if kind == 2:
        return Capsule(at, point(*(np.array(at) + rng.uniform(-0.35, 0.35, 3))), rng.uniform(0.02, 0.1), material)
    return Disc(at, point(*rng.normal(size=3)), rng.uniform(0.1, 0.3), material)


def _material(rng: np.random.Generator) -> Material:
    first, second = (point(*rng.uniform(0.02, 0.9, 3) ** 1.5) for _ in range(2))
    specular = (rng.uniform(0.1, 0.6), rng.uniform(10, 80)) if rng.random() < 0.4 else (0.0, 1.0)
    mirror = rng.uniform(0.05, 0.3) if rng.random() < 0.1 else 0.0
    return Material((first, second), str(rng.choice(PATTERNS)), rng.uniform(3, 12), specular, mirror)
