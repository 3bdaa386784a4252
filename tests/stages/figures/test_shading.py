"""Pictures of meshes: what faces the viewer is drawn, in its colour, as large as asked."""

from __future__ import annotations

import numpy as np

from efficientnerf.surface.mesh import Mesh
from stages.figures.shading import render_sides

PAPER = 237  # the background, of 255


def square(side: float, centre: tuple[float, float, float], colour: tuple[float, float, float]) -> tuple[np.ndarray, ...]:
    """A square that faces +x: vertices, faces, normals, colours."""
    corners = np.array([[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]]) * side / 2 + centre
    return corners, np.array([[0, 1, 2], [0, 2, 3]]), np.tile([1.0, 0, 0], (4, 1)), np.tile(colour, (4, 1))


def mesh_of(*parts: tuple[np.ndarray, ...]) -> Mesh:
    faces = np.concatenate([part[1] + 4 * n for n, part in enumerate(parts)])
    vertices, normals, colours = (np.concatenate([part[n] for part in parts]) for n in (0, 2, 3))
    return Mesh(vertices, faces, normals, colours, {})


def covered(picture: np.ndarray) -> float:
    return float((np.abs(picture.astype(int) - PAPER) > 3).any(axis=-1).mean())


def test_a_square_is_seen_from_its_front_in_its_colour() -> None:
    picture = render_sides(mesh_of(square(2.0, (0, 0, 0), (1.0, 0.0, 0.0))), elevation=0.0, size=100)
    assert picture.shape == (200, 400, 3)
    front, left, back = picture[:100, :100], picture[:100, 100:200], picture[:100, 200:300]
    assert tuple(front[50, 50]) == (255, 0, 0)
    assert 0.4 < covered(front) < 0.52  # half of the square about it: its corners touch the circle of reach
    assert covered(left) < 0.05
    assert covered(back) == 0
