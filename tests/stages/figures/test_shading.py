"""Pictures of meshes: what faces the viewer is drawn, in its colour, as large as asked."""

from __future__ import annotations

import numpy as np

from efficientnerf.surface.mesh import Mesh
from stages.figures.shading import IN_FRONT, render_sides

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


def test_views_from_the_front_alone_and_of_the_middle_alone() -> None:
    many = [square(0.02, (0, y, z), (0.0, 1.0, 0.0)) for y in np.linspace(-1, 1, 12) for z in np.linspace(-1, 1, 12)]
    far = square(8.0, (-40.0, 30.0, 0.0), (0.0, 0.0, 1.0))
    mesh = mesh_of(square(2.0, (-0.1, 0, 0), (1.0, 0.0, 0.0)), *many, far)
    whole = render_sides(mesh, elevation=0.0, size=100, turns=(0.0,))
    middle = render_sides(mesh, elevation=0.0, size=100, turns=(0.0,), shown=0.9)
    assert whole.shape == middle.shape == (200, 100, 3)
    assert covered(whole[:100]) < 0.1
    assert covered(middle[:100]) > 0.4
    assert not (middle[:100] == (0, 0, 255)).all(axis=-1).any()  # what is far is left out
    turned = render_sides(mesh, elevation=0.0, size=60, turns=IN_FRONT, shown=0.9)
    assert turned.shape == (120, 240, 3)
    assert all(covered(turned[:60, 60 * n : 60 * n + 60]) > 0.2 for n in range(4))
