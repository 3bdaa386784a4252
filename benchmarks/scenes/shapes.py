"""Shapes with closed-form ray intersections, and their materials. R rays; lengths in world units, z up."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

NEAREST = 1e-4  # an intersection nearer than this is the surface that the ray starts on
GOLDEN = np.pi * (3 - np.sqrt(5))  # the golden angle
Point = tuple[float, float, float]
Colours = tuple[Point, Point]  # linear RGB
RED: Colours = ((0.70, 0.10, 0.08), (0.85, 0.35, 0.15))
GREEN: Colours = ((0.08, 0.40, 0.12), (0.45, 0.60, 0.15))
BLUE: Colours = ((0.06, 0.14, 0.50), (0.30, 0.55, 0.80))
STONE: Colours = ((0.42, 0.38, 0.33), (0.66, 0.61, 0.54))
WOOD: Colours = ((0.40, 0.22, 0.10), (0.62, 0.40, 0.22))
DARK: Colours = ((0.06, 0.06, 0.07), (0.14, 0.14, 0.16))
CLAY: Colours = ((0.50, 0.22, 0.12), (0.66, 0.34, 0.20))


def point(*values: float) -> Point:
    """Three numbers, of an array perhaps, as shapes hold them."""
    x, y, z = (float(value) for value in values)
    return x, y, z


@dataclass(frozen=True)
class Material:
    """Two colours, mixed by a pattern, and how the surface reflects.

    pattern   "plain", "noise", "checks" or "stripes"
    scale     repetitions of the pattern for a world unit
    specular  Phong highlight's strength and exponent
    mirror    share of the reflected environment, 0 to 1
    """

    colours: Colours
    pattern: str = "plain"
    scale: float = 4.0
    specular: tuple[float, float] = (0.0, 1.0)
    mirror: float = 0.0


class Shape(Protocol):
    @property
    def material(self) -> Material: ...

    @property
    def ball(self) -> tuple[np.ndarray, float]:
        """Centre (3,) and radius of a ball that holds the shape."""
        ...

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """(R,) distance of the first intersection in front of each ray; infinite where there is none."""
        ...

    def normal(self, points: np.ndarray) -> np.ndarray:
        """(R, 3) outward unit normals at points of the surface."""
        ...


@dataclass(frozen=True)
class Sphere:
    centre: Point
    radius: float
    material: Material

    @property
    def ball(self) -> tuple[np.ndarray, float]:
        return np.array(self.centre), self.radius

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        offset = origins - np.array(self.centre)
        return _first_root(np.ones(len(offset)), (offset * directions).sum(-1), (offset**2).sum(-1) - self.radius**2)

    def normal(self, points: np.ndarray) -> np.ndarray:
        return (points - np.array(self.centre)) / self.radius


@dataclass(frozen=True)
class Box:
    """A box turned about the vertical axis by `heading` degrees."""

    centre: Point
    half: Point
    material: Material
    heading: float = 0.0

    @property
    def ball(self) -> tuple[np.ndarray, float]:
        return np.array(self.centre), float(np.linalg.norm(self.half))

    @property
    def rotation(self) -> np.ndarray:
        """(3, 3) from the box's axes to the world's."""
        c, s = np.cos(np.radians(self.heading)), np.sin(np.radians(self.heading))
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        o, d = (origins - np.array(self.centre)) @ self.rotation, directions @ self.rotation
        d = np.where(np.abs(d) < 1e-12, 1e-12, d)
        planes = (np.array([[-1.0], [1.0]])[:, None] * np.array(self.half) - o) / d  # (2, R, 3)
        enter, leave = planes.min(0).max(-1), planes.max(0).min(-1)
        t = np.where(enter > NEAREST, enter, leave)
        return np.where((enter <= leave) & (t > NEAREST), t, np.inf)

    def normal(self, points: np.ndarray) -> np.ndarray:
        local = (points - np.array(self.centre)) @ self.rotation / np.array(self.half)
        axis = np.abs(local).argmax(-1)
        out = np.zeros_like(local)
        rows = np.arange(len(local))
        out[rows, axis] = np.sign(local[rows, axis])
        return out @ self.rotation.T


@dataclass(frozen=True)
class Capsule:
    """All points within `radius` of the segment from `a` to `b`: a rod, or a thin wire."""

    a: Point
    b: Point
    radius: float
    material: Material

    @property
    def ball(self) -> tuple[np.ndarray, float]:
        a, b = np.array(self.a), np.array(self.b)
        return (a + b) / 2, float(np.linalg.norm(b - a)) / 2 + self.radius

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        a, axis = np.array(self.a), np.array(self.b) - np.array(self.a)
        offset, long = origins - a, float(axis @ axis)
        along_d, along_o = (directions * axis).sum(-1), (offset * axis).sum(-1)  # rounded alike whatever rays come along
        t = _first_root(long - along_d**2, long * (offset * directions).sum(-1) - along_o * along_d, long * ((offset**2).sum(-1) - self.radius**2) - along_o**2)
        with np.errstate(invalid="ignore"):
            at = along_o + t * along_d
            best = np.where(np.isfinite(t) & (at > 0) & (at < long), t, np.inf)
        for end in (self.a, self.b):
            best = np.minimum(best, Sphere(end, self.radius, self.material).hit(origins, directions))
        return best

    def normal(self, points: np.ndarray) -> np.ndarray:
        a, axis = np.array(self.a), np.array(self.b) - np.array(self.a)
        share = np.clip((points - a) @ axis / (axis @ axis), 0, 1)
        return (points - a - share[:, None] * axis) / self.radius


@dataclass(frozen=True)
class Disc:
    """A flat disc without thickness, seen from both sides: a leaf."""

    centre: Point
    axis: Point
    radius: float
    material: Material

    @property
    def ball(self) -> tuple[np.ndarray, float]:
        return np.array(self.centre), self.radius

    @property
    def unit(self) -> np.ndarray:
        """(3,) the axis, of length one."""
        axis = np.array(self.axis)
        return np.asarray(axis / np.linalg.norm(axis))

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        offset = np.array(self.centre) - origins
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (offset * self.unit).sum(-1) / (directions * self.unit).sum(-1)
            away = ((t[:, None] * directions - offset) ** 2).sum(-1)
        return np.where(np.isfinite(t) & (t > NEAREST) & (away <= self.radius**2), t, np.inf)

    def normal(self, points: np.ndarray) -> np.ndarray:
        return np.broadcast_to(self.unit, points.shape)


@dataclass(frozen=True)
class Ground:
    """The horizontal plane at a height, without end."""

    height: float
    material: Material

    @property
    def ball(self) -> tuple[np.ndarray, float]:
        return np.zeros(3), np.inf

    def hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (self.height - origins[:, 2]) / directions[:, 2]
        return np.where(np.isfinite(t) & (t > NEAREST), t, np.inf)

    def normal(self, points: np.ndarray) -> np.ndarray:
        return np.broadcast_to(np.array([0.0, 0.0, 1.0]), points.shape)


def _first_root(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """(R,) the least root above NEAREST of a t^2 + 2 b t + c; infinite where there is none."""
    inside = b**2 - a * c
    a = np.where(np.abs(a) < 1e-12, 1e-12, a)
    root = np.sqrt(np.maximum(inside, 0))
    first, second = (-b - root) / a, (-b + root) / a
    t = np.where(first > NEAREST, first, second)
    return np.where((inside >= 0) & (t > NEAREST), t, np.inf)
