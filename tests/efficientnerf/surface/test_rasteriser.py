"""Images of meshes against closed forms: silhouettes, depths, and which of two faces is in front."""

import numpy as np
import pytest
import trimesh

from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.surface.rasteriser import mesh_image
from tests.efficientnerf.surface.texturing.shapes import shown_points


def camera(model: str = "SIMPLE_PINHOLE", extra: tuple[float, ...] = ()) -> Camera:
    pose = np.eye(4)
    pose[:3, 3] = [0.1, -0.2, -3.0]
    return Camera("c", 48, 36, model, (60.0, 24.0, 18.0, *extra), pose)


@pytest.mark.parametrize(("model", "extra"), [("SIMPLE_PINHOLE", ()), ("SIMPLE_RADIAL", (-0.05,))])
def test_a_ball_is_where_its_rays_meet_it(model: str, extra: tuple[float, ...]) -> None:
    ball, view = trimesh.creation.icosphere(subdivisions=5, radius=0.7), camera(model, extra)
    image = mesh_image(np.asarray(ball.vertices), np.asarray(ball.faces), view)
    origins, directions = rays(view)
    along = -(origins * directions).sum(1)
    off = (origins**2).sum(1) - along**2
    clear = np.abs(np.sqrt(off) - 0.7) > 0.003  # not at the rim, where an icosphere is no ball
    hit = (off < 0.49).reshape(image.face.shape)
    assert (image.covered == hit).ravel()[clear].all()
    depth = ((along - np.sqrt(np.maximum(0.49 - off, 0))) * (directions @ view.forward)).reshape(image.depth.shape)
    both = hit & image.covered & (off < 0.4).reshape(hit.shape)
    np.testing.assert_allclose(image.depth[both], depth[both], atol=2e-3)
    assert np.isinf(image.depth[~image.covered]).all()
    np.testing.assert_allclose(np.linalg.norm(shown_points(image, view), axis=1), 0.7, atol=4e-3)


def test_a_sheet_has_no_cracks_and_the_nearer_one_hides_the_other() -> None:
    x, y = np.meshgrid(np.linspace(-4, 4, 40), np.linspace(-4, 4, 40))
    sheet = np.stack([x.ravel(), y.ravel(), 0.3 * x.ravel()], 1)
    at = np.arange(39)[:, None] * 40 + np.arange(39)
    faces = np.concatenate([np.stack([at, at + 1, at + 40], -1).reshape(-1, 3), np.stack([at + 1, at + 41, at + 40], -1).reshape(-1, 3)])
    vertices = np.concatenate([sheet, sheet - [0, 0, 0.5]])
    image = mesh_image(vertices, np.concatenate([faces, faces + len(sheet)]), camera())
    assert (image.face >= len(faces)).all()
    turned = mesh_image(vertices, np.concatenate([faces, faces + len(sheet)])[:, ::-1], camera())
    np.testing.assert_array_equal(turned.face, image.face)  # from either side


def test_of_equal_faces_the_first_is_shown_and_what_reaches_behind_is_not() -> None:
    corners = np.array([[-9.0, -9, 0], [9, -9, 0], [0, 20, 0], [0, 0, -5.0]])
    image = mesh_image(corners, np.array([[0, 1, 3], [0, 1, 2], [2, 1, 0], [0, 0, 1]]), camera())
    assert (image.face == 1).all()
    assert not mesh_image(corners, np.zeros((0, 3), np.int64), camera()).covered.any()


def test_hostile_vertices_end_nothing() -> None:
    rng = np.random.default_rng(0)
    vertices = rng.normal(size=(300, 3)) * 10.0 ** rng.integers(-30, 30, (300, 1))
    vertices[::7] = np.nan
    with np.errstate(all="ignore"):
        image = mesh_image(vertices, rng.integers(0, 300, (400, 3)), camera())
    assert (image.face < 400).all()
