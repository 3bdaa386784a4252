"""Directions across and against given ones. N directions."""

import numpy as np


def across(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors (N, 3) each, at right angles to unit directions (N, 3) and to each other: first, second and direction are right-handed."""
    helper = np.where(np.abs(directions[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    first = np.cross(helper, directions)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(directions, first)


def outside_directions(normal: np.ndarray) -> list[np.ndarray]:
    """Six unit ray directions (N, 3) each, towards a surface with these outward normals: one head on and five at 45 degrees."""
    first, second = across(normal)
    slanted = [-(normal + np.cos(angle) * first + np.sin(angle) * second) * np.sqrt(0.5) for angle in np.arange(5) * (2 * np.pi / 5)]
    return [-normal, *slanted]
