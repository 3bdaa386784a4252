"""Scenes of thin things: a plant, a wire-frame ball, a fence of bars, a word of bars. Two layouts, one for choosing constants and one for reports."""

from itertools import pairwise

import numpy as np

from benchmarks.scenes.shapes import BLUE, CLAY, GOLDEN, GREEN, RED, STONE, Box, Capsule, Disc, Material, Point, Shape, Sphere, point

# Strokes of letters in a square of one by one, from the lower left.
LETTERS: dict[str, tuple[tuple[float, float, float, float], ...]] = {
    "E": ((0, 0, 0, 1), (0, 1, 0.7, 1), (0, 0.5, 0.55, 0.5), (0, 0, 0.7, 0)),
    "R": ((0, 0, 0, 1), (0, 1, 0.6, 1), (0.6, 1, 0.6, 0.5), (0.6, 0.5, 0, 0.5), (0.2, 0.5, 0.7, 0)),
    "F": ((0, 0, 0, 1), (0, 1, 0.7, 1), (0, 0.5, 0.55, 0.5)),
    "N": ((0, 0, 0, 1), (0, 1, 0.7, 0), (0.7, 0, 0.7, 1)),
    "T": ((0.35, 0, 0.35, 1), (0, 1, 0.7, 1)),
}  # fmt: skip


def plant(at: tuple[float, float], stems: int, leaves: int, seed: int) -> list[Shape]:
    """A pot with stems that lean outwards, and discs as leaves along them."""
    rng = np.random.default_rng(seed)
    x, y = at
    out: list[Shape] = [Capsule((x, y, 0.08), (x, y, 0.16), 0.1, Material(CLAY, "noise", 8.0))]
    for stem in range(stems):
        angle = GOLDEN * stem + rng.uniform(-0.2, 0.2)
        lean, height = rng.uniform(0.08, 0.26), rng.uniform(0.5, 0.8)
        top = np.array([x + lean * np.cos(angle), y + lean * np.sin(angle), height])
        foot = np.array([x, y, 0.2])
        out.append(Capsule(point(*foot), point(*top), 0.007, Material(GREEN, "plain")))
        for leaf in range(leaves):
            along = 0.35 + 0.65 * (leaf + 0.5) / leaves
            turn = GOLDEN * leaf + angle
            away = np.array([np.cos(turn), np.sin(turn), 0.3])
            radius = rng.uniform(0.035, 0.055)
            centre = foot + along * (top - foot) + radius * away
            out.append(
                Disc(point(*centre), point(*(np.cross(away, [-away[1], away[0], 0.0]) + rng.normal(0, 0.2, 3))), radius, Material(GREEN, "noise", 14.0))
            )
    return out


def wire_ball(centre: Point, radius: float, wire: float, rings: int) -> list[Shape]:
    """Rings about three axes, of capsules."""
    out: list[Shape] = []
    steel = Material(((0.20, 0.21, 0.24), (0.34, 0.35, 0.38)), "noise", 10.0)
    for ring in range(rings):
        turn = np.pi * ring / rings
        first, second = np.array([np.cos(turn), np.sin(turn), 0.0]), np.array([0.0, 0.0, 1.0])
        places = [np.array(centre) + radius * (np.cos(a) * first + np.sin(a) * second) for a in 2 * np.pi * np.arange(25) / 24]
        out += [Capsule(point(*a), point(*b), wire, steel) for a, b in pairwise(places)]
    flat = [np.array(centre) + radius * np.array([np.cos(a), np.sin(a), 0.0]) for a in 2 * np.pi * np.arange(25) / 24]
    return out + [Capsule(point(*a), point(*b), wire, steel) for a, b in pairwise(flat)]


def fence(start: Point, end: Point, height: float, bars: int, bar: float) -> list[Shape]:
    """Upright bars between two rails and crossed by two more."""
    a, b = np.array(start), np.array(end)
    paint = Material(STONE, "noise", 12.0)
    uprights: list[Shape] = []
    for share in np.linspace(0, 1, bars):
        foot = a + share * (b - a)
        uprights.append(Capsule(point(*foot), point(foot[0], foot[1], foot[2] + height), bar, paint))
    heights = [np.array([0.0, 0.0, share * height]) for share in np.linspace(0.1, 0.95, 4)]
    rails = [Capsule(point(*(a + up)), point(*(b + up)), bar, paint) for up in heights]
    return [*uprights, *rails]


def word(text: str, start: Point, heading: float, size: float, stroke: float) -> list[Shape]:
    """Upright letters of capsules along a heading, degrees."""
    along = np.array([np.cos(np.radians(heading)), np.sin(np.radians(heading)), 0.0])
    up, paint = np.array([0.0, 0.0, 1.0]), Material(RED, "noise", 6.0)
    out: list[Shape] = []
    for number, letter in enumerate(text):
        origin = np.array(start) + 0.95 * size * number * along
        for x, y, u, v in LETTERS[letter]:
            out.append(Capsule(point(*(origin + size * (x * along + y * up))), point(*(origin + size * (u * along + v * up))), stroke, paint))
    return out


def thicket() -> tuple[Shape, ...]:
    """For choosing constants."""
    return (
        Box((0.0, 0.0, 0.03), (0.62, 0.62, 0.03), Material(STONE, "checks", 6.0)),
        *plant((-0.3, 0.25), 7, 5, 1),
        *wire_ball((0.32, 0.28, 0.3), 0.22, 0.009, 4),
        *fence((-0.5, -0.5, 0.06), (0.1, -0.5, 0.06), 0.4, 12, 0.009),
        *word("NERF", (-0.3, -0.2, 0.09), 10.0, 0.22, 0.016),
        Sphere((0.42, -0.35, 0.2), 0.14, Material(BLUE, "noise", 7.0)),
    )


def garden() -> tuple[Shape, ...]:
    """For reports: other places, sizes and thicknesses."""
    return (
        Box((0.0, 0.0, 0.03), (0.66, 0.5, 0.03), Material(CLAY, "noise", 5.0)),
        *plant((0.34, 0.1), 9, 4, 7),
        *wire_ball((-0.36, 0.22, 0.28), 0.2, 0.008, 5),
        *fence((-0.55, -0.3, 0.06), (-0.1, -0.44, 0.06), 0.5, 9, 0.008),
        *word("TREE", (-0.2, -0.05, 0.08), -15.0, 0.18, 0.013),
        Box((0.42, -0.32, 0.16), (0.1, 0.1, 0.1), Material(BLUE, "checks", 9.0), heading=20.0),
    )
