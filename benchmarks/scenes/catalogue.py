"""Six kinds of scenes: what is in them, and where the cameras of each split stand.

object   an object with alpha: bounded
court    an object in a court with surroundings out to 40 units: unbounded
window   a street seen from one side, from 2 to 60 units away: forward-facing
gloss    mirrors, highlights and wires thinner than a pixel, with alpha: bounded
thicket  a plant, a wire-frame ball, a fence and a word, with alpha: bounded
garden   the same otherwise: for reports alone
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.scenes.rendering import SUN
from benchmarks.scenes.shapes import BLUE, DARK, GOLDEN, GREEN, RED, STONE, WOOD, Box, Capsule, Ground, Material, Shape, Sphere
from benchmarks.scenes.thin import garden, thicket
from efficientnerf.geometry.cameras import Camera
from tests.poses import looking_at

PHASE = {"train": 0.0, "val": 0.37, "test": 0.71}  # splits take other places on the same path



@dataclass(frozen=True)
class Recipe:
    """shapes; whether images have alpha; (phase, index, count) -> place and target of a camera; focal length over image width;
    whether all cameras look the same way; direction of the light."""

    shapes: tuple[Shape, ...]
    alpha: bool
    place: Callable[[float, int, int], tuple[np.ndarray, np.ndarray]]
    focal: float
    forward_facing: bool = False
    sun: tuple[float, float, float] = SUN


def look_at(name: str, centre: np.ndarray, target: np.ndarray, size: int, focal: float) -> Camera:
    """A pinhole camera; z of the world is up in its image."""
    return Camera(name, size, 3 * size // 4, "SIMPLE_PINHOLE", (focal * size, size / 2, 3 * size / 8), looking_at(centre, target))


def cameras(recipe: Recipe, split: str, count: int, size: int) -> list[Camera]:
    """`count` cameras of a split; each split has places of its own."""
    out = []
    for n in range(count):
        centre, target = recipe.place(PHASE[split], n, count)
        out.append(look_at(f"images/{split}_{n:03d}.png", centre, target, size, recipe.focal))
    return out


def dome(radius: float, lowest: float, highest: float, target: tuple[float, float, float]) -> Callable[[float, int, int], tuple[np.ndarray, np.ndarray]]:
    """Places on a dome, in a spiral of golden angles; elevations in degrees."""

    def place(phase: float, n: int, count: int) -> tuple[np.ndarray, np.ndarray]:
        low, high = np.sin(np.radians([lowest, highest]))
        height = low + (high - low) * (n + 0.5) / count
        angle, flat = GOLDEN * (n + phase * 17), np.sqrt(1 - height**2)
        at = np.array(target)
        return at + radius * np.array([flat * np.cos(angle), flat * np.sin(angle), height]), at

    return place


def _window(phase: float, n: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Places in an upright rectangle, by the R2 sequence (Roberts 2018), looking along +y."""
    u, v = np.modf(phase + 0.7548776662 * (n + 1))[0], np.modf(phase + 0.5698402910 * (n + 1))[0]
    centre = np.array([1.4 * (u - 0.5), 0.12 * np.sin(9 * u + 5 * v), 1.2 + 0.9 * (v - 0.5)])
    return centre, np.array([0.15 * (u - 0.5), 8.0, 1.2 + 0.1 * (v - 0.5)])


def _toy() -> tuple[Shape, ...]:
    return (
        Box((0.0, 0.0, 0.06), (0.62, 0.62, 0.06), Material(WOOD, "stripes", 3.0)),
        Box((-0.22, 0.15, 0.37), (0.24, 0.24, 0.25), Material(BLUE, "checks", 7.0), heading=24.0),
        Box((-0.22, 0.15, 0.72), (0.15, 0.15, 0.10), Material(RED, "noise", 9.0), heading=57.0),
        Sphere((0.27, -0.12, 0.34), 0.22, Material(GREEN, "noise", 8.0, specular=(0.25, 40.0))),
        Capsule((-0.45, -0.42, 0.2), (0.35, -0.48, 0.2), 0.08, Material(RED, "stripes", 6.0)),
        Capsule((0.40, 0.40, 0.12), (0.40, 0.40, 0.95), 0.045, Material(STONE, "noise", 12.0)),
        Sphere((0.40, 0.40, 1.0), 0.11, Material(BLUE, "stripes", 8.0)),
    )


def _court() -> tuple[Shape, ...]:
    walls = []
    for n in range(14):
        angle, away = 2 * np.pi * n / 14, 7.0 + 5.0 * (n * 7 % 5)
        colours = (STONE, RED, WOOD, GREEN)[n % 4]
        height = 1.2 + 0.9 * (n * 3 % 4)
        walls.append(
            Box(
                (away * np.cos(angle), away * np.sin(angle), height), (0.8 + 0.1 * away, 0.4, height), Material(colours, "noise", 1.6),
                heading=float(np.degrees(angle)) + 90,
            )
        )  # fmt: skip
    hills = [Sphere((40 * np.cos(a), 40 * np.sin(a), -6.0), 12.0, Material(GREEN, "noise", 0.4)) for a in (0.4, 1.7, 2.9, 4.4, 5.5)]
    return (*_toy(), Ground(0.0, Material(STONE, "noise", 2.5)), *walls, *hills)


def _street() -> tuple[Shape, ...]:
    posts = [
        Capsule((x, 3.0 + 1.7 * n, 0.0), (x, 3.0 + 1.7 * n, 2.1), 0.07, Material((RED, BLUE, STONE)[n % 3], "stripes", 3.0))
        for n, x in enumerate((-1.1, 0.9, -0.4, 1.8, -2.2))
    ]
    houses = [
        Box((x, y, h), (1.6, 1.2, h), Material((STONE, WOOD, RED, BLUE)[n % 4], "checks" if n % 2 else "noise", 1.5), heading=6.0 * n)
        for n, (x, y, h) in enumerate(((-4.0, 9.0, 1.8), (3.6, 11.0, 2.4), (-1.0, 18.0, 3.0), (8.0, 24.0, 4.0), (-11.0, 28.0, 5.0), (3.0, 45.0, 6.0)))
    ]
    near = (
        Box((-0.75, 2.6, 0.45), (0.3, 0.25, 0.45), Material(GREEN, "noise", 6.0), heading=20.0),
        Sphere((0.6, 2.4, 0.35), 0.3, Material(BLUE, "checks", 6.0)),
    )
    return (Ground(0.0, Material(STONE, "noise", 1.5)), *near, *posts, *houses, Sphere((-14.0, 60.0, -4.0), 13.0, Material(GREEN, "noise", 0.3)))


def _gloss() -> tuple[Shape, ...]:
    steel = Material(DARK, specular=(0.9, 60.0), mirror=0.25)
    wires: list[Shape] = []
    for n in range(16):  # a cage of meridians and rings
        a, b = 2 * np.pi * n / 16, 2 * np.pi * (n + 1) / 16
        for low, high in ((0.05, 0.55), (0.55, 1.05)):
            bottom, top = (0.62 if z < 0.3 or z > 0.9 else 0.75 for z in (low, high))
            wires.append(Capsule((bottom * np.cos(a), bottom * np.sin(a), low), (top * np.cos(a), top * np.sin(a), high), 0.008, steel))
        wires += [
            Capsule((r * np.cos(a), r * np.sin(a), z), (r * np.cos(b), r * np.sin(b), z), 0.012, steel) for r, z in ((0.62, 0.05), (0.75, 0.55), (0.62, 1.05))
        ]
    return (
        Box((0.0, 0.0, 0.02), (0.8, 0.8, 0.02), Material(WOOD, "stripes", 4.0, specular=(0.3, 30.0))),
        Sphere((0.12, 0.05, 0.36), 0.28, Material(((0.7, 0.7, 0.72), (0.7, 0.7, 0.72)), mirror=0.85)),
        Sphere((-0.32, -0.22, 0.22), 0.16, Material(RED, "noise", 7.0, specular=(0.8, 120.0), mirror=0.2)),
        Box((-0.25, 0.33, 0.2), (0.13, 0.13, 0.17), Material(BLUE, "checks", 9.0, specular=(0.5, 80.0), mirror=0.3), heading=35.0),
        *wires,
    )


def recipes() -> dict[str, Recipe]:
    """Every kind, by name."""
    return {
        "object": Recipe(_toy(), True, dome(3.4, -5.0, 70.0, (0.0, 0.0, 0.45)), 1.4),
        "court": Recipe(_court(), False, dome(3.2, 8.0, 40.0, (0.0, 0.0, 0.4)), 0.9),
        "window": Recipe(_street(), False, _window, 0.9, forward_facing=True),
        "thicket": Recipe(thicket(), True, dome(3.0, -5.0, 70.0, (0.0, 0.0, 0.3)), 1.5),
        "garden": Recipe(garden(), True, dome(3.0, -5.0, 70.0, (0.0, 0.0, 0.3)), 1.5),
        "gloss": Recipe(_gloss(), True, dome(3.6, -5.0, 70.0, (0.0, 0.0, 0.5)), 1.4),
    }
