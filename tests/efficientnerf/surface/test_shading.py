"""Images of textured meshes against closed forms and slow loops."""

from dataclasses import replace

import numpy as np
import pytest

from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.surface import shading
from efficientnerf.surface.mesh import Mesh, Texture
from efficientnerf.surface.shading import Shader, vertex_colours
from tests.efficientnerf.surface.texturing.shapes import ball, cameras
from tests.efficientnerf.threads import on_threads

FRONT = np.eye(4)
FRONT[:3, 3] = [0, 0, -2.0]
VIEW = Camera("c", 24, 18, "SIMPLE_PINHOLE", (20.0, 12.0, 9.0), FRONT)  # looks along +z, y down


def sheet(picture: np.ndarray, tilt: float = 0.0) -> Mesh:
    """A square from -1 to 1 in x and y, turned about y, that shows a picture as it is: u along x, v against y, which points down in the image."""
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    places = np.stack([(corners[:, 0] + 1) / 2, (1 - corners[:, 1]) / 2], 1)
    vertices = np.stack([corners[:, 0] * np.cos(tilt), corners[:, 1], corners[:, 0] * np.sin(tilt)], 1)
    return Mesh(vertices, faces, np.tile([0.0, 0, -1], (4, 1)), np.zeros((4, 3), np.float32), texture=Texture(places[faces], picture))


def smooth_picture(side: int) -> np.ndarray:
    y, x = (np.mgrid[0:side, 0:side] + 0.5) / side
    return np.round(255 * np.stack([x, y, 0.5 + 0.4 * np.sin(3 * x + 2 * y)], -1)).astype(np.uint8)


@pytest.mark.parametrize("tilt", [0.0, 0.7])
def test_each_pixel_shows_the_place_of_the_texture_that_its_ray_meets(tilt: float) -> None:
    """u = x, v = y are in the colours themselves; perspective included."""
    image, _ = Shader(sheet(smooth_picture(64), tilt)).images(VIEW)
    origins, directions = rays(VIEW)
    normal = np.array([-np.sin(tilt), 0, np.cos(tilt)])
    at = origins - directions * ((origins @ normal) / (directions @ normal))[:, None]
    place = np.stack([(at @ [np.cos(tilt), 0, np.sin(tilt)] + 1) / 2, (at[:, 1] + 1) / 2], 1)
    inside = ((place > 0.06) & (place < 0.94)).all(1)
    found, depth = image.colour.reshape(-1, 3), image.depth.ravel()
    np.testing.assert_allclose(found[inside, :2], place[inside], atol=0.006)
    np.testing.assert_allclose(image.covered.ravel()[inside], 1)
    nearest = ((at - origins) @ VIEW.forward)[inside]
    assert (depth[inside] <= nearest + 1e-6).all()
    np.testing.assert_allclose(depth[inside], nearest, atol=0.06)
    far = ((place < -0.1) | (place > 1.1)).any(1)
    assert (image.covered.ravel()[far] == 0).all()
    assert np.isinf(depth[far]).all()


def test_fine_textures_are_averaged_not_sampled_at_points() -> None:
    """A chequerboard of single texels, 50 of them to a pixel, is grey."""
    board = np.zeros((1024, 1024, 3), np.uint8)
    board[::2, ::2] = board[1::2, 1::2] = 255
    image, _ = Shader(sheet(board)).images(VIEW)
    np.testing.assert_allclose(image.colour[6:12, 8:16], 0.5, atol=0.01)


def test_vertices_are_blended_across_faces_with_perspective() -> None:
    mesh = sheet(np.zeros((1, 1, 3), np.uint8), 0.7)
    places = (np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]]) + 1) / 2
    coloured = replace(mesh, texture=None, colours=np.concatenate([places, np.ones((4, 1))], 1).astype(np.float32))
    textured, plain = Shader(coloured).images(VIEW)
    assert textured is plain
    picture = np.round(255 * np.stack([*np.meshgrid((np.arange(256) + 0.5) / 256, (np.arange(256) + 0.5) / 256), np.ones((256, 256))], -1)).astype(np.uint8)
    other = Shader(sheet(picture, 0.7)).images(VIEW)[0]
    np.testing.assert_allclose(plain.colour, other.colour, atol=0.006)


def test_colours_of_vertices_come_nearest_to_the_texture() -> None:
    """Of a texture that vertices can show it is shown, nearly; of a fine chequerboard they are grey, where the texel at a vertex is black or white."""
    flat = np.broadcast_to(np.array([10, 200, 90], np.uint8), (16, 16, 3))
    np.testing.assert_allclose(vertex_colours(sheet(flat)), np.tile(flat[0, 0] / 255, (4, 1)), atol=1e-6)
    board = np.zeros((60, 60, 3), np.uint8)
    board[::2, ::2] = board[1::2, 1::2] = 255
    np.testing.assert_allclose(vertex_colours(sheet(board), parts=24), 0.5, atol=0.05)
    loose = sheet(flat)
    loose = replace(loose, vertices=np.concatenate([loose.vertices, [[9.0, 9, 9]]]), colours=np.full((5, 3), 0.25, np.float32))
    np.testing.assert_allclose(vertex_colours(loose)[4], 0.25)


def test_hostile_meshes_end_nothing() -> None:
    rng = np.random.default_rng(0)
    vertices = rng.normal(size=(60, 3)) * 10.0 ** rng.integers(-12, 12, (60, 1))
    faces = rng.integers(0, 60, (80, 3))
    places = rng.normal(size=(80, 3, 2)) * 10.0 ** rng.integers(-12, 12, (80, 1, 1))
    mesh = Mesh(vertices, faces, vertices, np.zeros((60, 3), np.float32), texture=Texture(places, smooth_picture(5)))
    with np.errstate(all="ignore"):
        for image in Shader(mesh).images(VIEW):
            assert image.colour.shape == (18, 24, 3)


def test_the_image_is_the_same_on_one_thread_and_on_two() -> None:
    shader = Shader(sheet(smooth_picture(64), 0.4))
    first = shader.images(VIEW)[0].colour
    with on_threads(1):
        np.testing.assert_array_equal(shader.images(VIEW)[0].colour, first)


def test_bands_of_rows_are_the_whole_image(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, faces = ball(2)
    mesh = Mesh(vertices, faces, vertices, (0.5 + 0.5 * vertices).astype(np.float32))
    camera = cameras(3, 37)[1]
    whole = Shader(mesh).images(camera)[0]
    monkeypatch.setattr(shading, "AT_ONCE", 16 * 37 * 5)
    banded = Shader(mesh).images(camera)[0]
    assert whole.covered.any()
    np.testing.assert_allclose(banded.covered, whole.covered, atol=1 / 16)
    assert (banded.covered == whole.covered).mean() > 0.99
    np.testing.assert_allclose(banded.colour, whole.colour, atol=0.1)
    np.testing.assert_allclose(banded.depth, whole.depth, rtol=0.01)
