"""Textures from photographs: known colours come back, and what spoils single photographs does not."""

from dataclasses import replace

import numpy as np
import pytest

from efficientnerf.geometry.cameras import project
from efficientnerf.surface.mesh import Mesh, vertex_normals
from efficientnerf.surface.texturing.atlas import atlas_of
from efficientnerf.surface.texturing.filling import carried_on
from efficientnerf.surface.texturing.photographs import REACH, PhotographTexture, Survey, edge_distance, exposed_alike, photograph, survey
from tests.efficientnerf.threads import on_threads

from .shapes import ball, box, cameras, pattern, photographed, textured


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(((a - b) ** 2).mean()))


@pytest.mark.parametrize("shape", [ball, box])
def test_known_colours_come_back(shape: object) -> None:
    vertices, faces = shape()  # type: ignore[operator]
    atlas, colours, known = textured(vertices, faces, [photographed(vertices, faces, camera) for camera in cameras(10)])
    truth = pattern(atlas.texels.values(vertices, faces))
    assert (known > 0.9).mean() > 0.9
    assert psnr(colours[known > 0.9], truth[known > 0.9]) > 35


def test_the_background_does_not_rub_off() -> None:
    vertices, faces = ball(3)
    photos = [photographed(vertices, faces, camera, behind=0.0) for camera in cameras(10)]
    atlas, colours, known = textured(vertices, faces, photos)
    seen = known > 0.5
    assert np.abs(colours - pattern(atlas.texels.values(vertices, faces)))[seen].max() < 0.15


def test_what_passes_by_in_one_photograph_is_left_out() -> None:
    vertices, faces = ball(3)
    photos = [photographed(vertices, faces, camera) for camera in cameras(12)]
    spoiled = photos[4].colours.copy()
    spoiled[30:66, 30:66] = [255, 0, 0]
    atlas, colours, known = textured(vertices, faces, [*photos[:4], replace(photos[4], colours=spoiled), *photos[5:]])
    clean = textured(vertices, faces, photos)[1]
    truth = pattern(atlas.texels.values(vertices, faces))
    assert psnr(colours[known > 0.9], truth[known > 0.9]) > 30
    assert np.abs(colours - clean).mean() < 0.01


def test_a_photograph_of_another_exposure_is_corrected() -> None:
    vertices, faces = ball(4)
    photos = [photographed(vertices, faces, camera) for camera in cameras(8)]
    photos[2] = replace(photos[2], colours=np.round(photos[2].colours * 0.7).astype(np.uint8))
    surveys = exposed_alike([survey(vertices, faces, vertex_normals(vertices, faces), pattern(vertices), photo) for photo in photos])
    np.testing.assert_allclose(surveys[2].gains, 1 / 0.7, rtol=0.05)
    np.testing.assert_allclose([each.gains for n, each in enumerate(surveys) if n != 2], 1, atol=1e-9)  # small differences are not touched
    atlas, colours, known = textured(vertices, faces, photos)
    truth = pattern(atlas.texels.values(vertices, faces))
    assert psnr(colours[known > 0.9], truth[known > 0.9]) > 33


def test_photographs_keep_their_colours_where_the_mesh_has_others() -> None:
    vertices, faces = ball(4)
    photos = [photographed(vertices, faces, camera) for camera in cameras(8)]
    surveys = exposed_alike([survey(vertices, faces, vertex_normals(vertices, faces), 0.7 * pattern(vertices), photo) for photo in photos])
    np.testing.assert_array_equal([each.gains for each in surveys], 1)


def test_a_photograph_that_shows_too_little_keeps_its_colours() -> None:
    shown = Survey(np.ones(1, np.float32), 1.0, np.full(3, 1.5))
    gains = [each.gains for each in exposed_alike([shown, replace(shown, gains=np.full(3, np.nan)), shown, replace(shown, gains=np.full(3, 0.75))])]
    np.testing.assert_allclose(gains, [[1.0] * 3, [1.0] * 3, [1.0] * 3, [0.5] * 3], rtol=1e-9, atol=0)


def test_a_face_that_is_hidden_gets_nothing() -> None:
    """A small box before a large one: where it stands in the way of the only camera the large one stays as was expected."""
    camera = cameras(1)[0]
    back, faces = box((1.0, 1.0, 1.0))
    front = 0.35 * back + 0.55 * camera.centre / np.linalg.norm(camera.centre) * 2
    vertices, both = np.concatenate([back, front]), np.concatenate([faces, faces + len(back)])
    photo = photographed(vertices, both, camera, lambda points: np.where(np.linalg.norm(points, axis=1, keepdims=True) > 0.87, [1.0, 0, 0], [0, 0, 1.0]))
    atlas, colours, known = textured(vertices, both, [photo])
    points, own = atlas.texels.values(vertices, both), atlas.texels.face < 12
    # Towards the camera, is the front box in between?
    pixels, _ = project(camera, points)
    red = photo.colours[np.clip(pixels[:, 1], 0, 95).astype(int), np.clip(pixels[:, 0], 0, 95).astype(int), 0] > 128
    assert (known[own & red] < 0.01).all()
    assert (colours[own & (known > 0.9)][:, 0] < 0.1).all()
    assert (known[own] > 0.9).any()
    assert (known[~own] > 0.9).any()


def test_where_nothing_is_seen_the_colours_beside_it_are_carried_on() -> None:
    """The asset is black where no photograph looks: it is believed nowhere, but where photographs show none of the mesh."""
    vertices, faces = ball(4)
    photos = [photographed(vertices, faces, camera, lambda points: np.full((len(points), 3), [0.8, 0.4, 0.2])) for camera in cameras(4) if camera.centre[2] > 0]
    normals = vertex_normals(vertices, faces)
    surveys = [survey(vertices, faces, normals, pattern(vertices), photo) for photo in photos]
    atlas = atlas_of(vertices, faces, np.inf, 128)
    texels = PhotographTexture(vertices, faces, normals, atlas, np.max([each.density for each in surveys], axis=0), 0.0)
    for photo, each in zip(photos, surveys, strict=True):
        texels.look(photo, replace(each, gains=np.ones(3)))
    mesh = Mesh(vertices, faces, normals, np.where(vertices[:, 2:] > 0, np.float32(0.5), np.float32(0)).repeat(3, axis=1))
    colours, known = texels.finished(mesh)
    points = atlas.texels.values(vertices, faces)
    apart = np.linalg.norm(points[:, None] - points[known > 0.9][::7], axis=2).min(1)
    unseen = known == 0
    off = np.abs(colours[unseen & (apart < 0.35)] / 255 - [0.8, 0.4, 0.2])
    assert off.max() < 0.1
    assert off.mean() < 0.01
    far = unseen & (apart > 0.9) & (points[:, 2] < -0.1)
    assert far.any()
    np.testing.assert_allclose(colours[far] / 255, np.tile([0.8, 0.4, 0.2], (far.sum(), 1)), atol=0.1)
    nothing = np.zeros(len(points), np.float32)
    np.testing.assert_array_equal(carried_on(mesh, atlas, colours, nothing, colours), mesh.colours)


def test_masks_and_alpha_are_kept_to() -> None:
    vertices, faces = ball(3)
    camera = cameras(1)[0]
    photo = photographed(vertices, faces, camera)
    left = np.arange(96) < 48
    alpha = np.where(left, np.uint8(255), np.uint8(249)) * np.ones((96, 1), np.uint8)
    for spoiled in (photograph(camera, photo.colours, np.tile(left, (96, 1))), photograph(camera, np.dstack([photo.colours, alpha]))):
        atlas, _, known = textured(vertices, faces, [spoiled])
        pixels, _ = project(camera, atlas.texels.values(vertices, faces))
        assert known[pixels[:, 0] > 48].max() == 0
        assert known[pixels[:, 0] < 40].max() > 0.9


def test_the_same_bytes_on_any_number_of_threads() -> None:
    vertices, faces = ball(3)
    photos = [photographed(vertices, faces, camera) for camera in cameras(5)]
    first = textured(vertices, faces, photos)[1]
    with on_threads(1):
        np.testing.assert_array_equal(textured(vertices, faces, photos)[1], first)


def test_a_texel_sees_all_pixels_that_lie_in_it() -> None:
    """Photographs that are finer than the texture: a chequered pattern of pixels becomes its mean, not either colour."""
    vertices, faces = ball(3)
    photos = []
    for camera in cameras(6, size=192):
        photo = photographed(vertices, faces, camera, lambda points: np.full((len(points), 3), 0.5))
        y, x = np.mgrid[:192, :192]
        photos.append(replace(photo, colours=np.repeat(np.where((x + y) % 2, np.uint8(255), np.uint8(0))[..., None], 3, axis=2)))
    _, colours, known = textured(vertices, faces, photos, size=64)
    assert np.abs(colours[known > 0.95] - 0.5).max() < 0.06


@pytest.mark.parametrize(("tilt", "gap"), [(0.0, 0.005), (0.9, 0.03)])
def test_no_photograph_shows_what_lies_close_behind_a_thin_sheet(tilt: float, gap: float) -> None:
    """Two sheets that face the camera, one a small share of the distance behind the other: thin parts do not show through, as far as pixels tell."""
    camera = cameras(1)[0]
    distance = float(np.linalg.norm(camera.centre))
    towards = camera.centre / distance
    along = np.cross(towards, [0.0, 0.0, 1.0])
    along /= np.linalg.norm(along)
    up = np.cross(along, towards)
    along, normal = np.cos(tilt) * along + np.sin(tilt) * towards, np.cos(tilt) * towards - np.sin(tilt) * along
    grid = np.stack(np.meshgrid([-0.4, 0.0, 0.4], [-0.4, 0.0, 0.4], indexing="ij"), -1).reshape(-1, 2)
    front = grid[:, :1] * along + grid[:, 1:] * up
    back = 0.6 * front - gap * distance * normal
    corners = np.array([[0, 3, 4], [0, 4, 1], [1, 4, 5], [1, 5, 2], [3, 6, 7], [3, 7, 4], [4, 7, 8], [4, 8, 5]])
    if np.cross(front[3] - front[0], front[4] - front[0]) @ towards < 0:
        corners = corners[:, ::-1]
    vertices, faces = np.concatenate([front, back]), np.concatenate([corners, corners + len(front)])
    photo = photographed(vertices, faces, camera, lambda points: np.full((len(points), 3), [1.0, 0.0, 0.0]))
    atlas, _, known = textured(vertices, faces, [photo])
    behind = atlas.texels.face >= len(corners)
    assert (known[behind] < 0.01).all()
    assert (known[~behind] > 0.9).mean() > 0.3  # the rest is near the edges


def test_distances_are_those_of_a_chamfer_from_what_may_not_be_used() -> None:
    """On a plane, where depths do not jump: the least way of steps of 1 along rows and columns, and of 1.4 along diagonals."""
    rng = np.random.default_rng(3)
    usable = rng.random((70, 33)) > 0.004
    found = edge_distance(usable, np.full(usable.shape, 0.5, np.float32))
    y, x = np.mgrid[: usable.shape[0], : usable.shape[1]]
    expected = np.full(usable.shape, 4 * REACH)
    for row, column in np.argwhere(~usable):
        along, across = np.abs(y - row), np.abs(x - column)
        expected = np.minimum(expected, np.maximum(along, across) + 0.4 * np.minimum(along, across))
    assert (~usable).sum() > 3
    np.testing.assert_allclose(found, expected, atol=1e-4)
    assert (edge_distance(usable, np.where(x < 16, 0.5, 0.4).astype(np.float32))[:, 15:17] == 0).all()


@pytest.mark.parametrize("after", [0, 5])
def test_a_signal_stops_it_within_a_photograph(after: int) -> None:
    """In the survey of one, in what texels see of one, and when all have been seen."""
    vertices, faces = ball(2)
    normals, photo, left = vertex_normals(vertices, faces), photographed(*ball(2), cameras(1)[0]), [after]
    found = survey(vertices, faces, normals, pattern(vertices), photo)
    texels = PhotographTexture(vertices, faces, normals, atlas_of(vertices, faces, np.inf, 64), found.density, found.sharpness)
    mesh = Mesh(vertices, faces, normals, pattern(vertices).astype(np.float32))

    def tick() -> None:
        left[0] -= 1
        if left[0] < 0:
            raise InterruptedError

    for work in (lambda: survey(vertices, faces, normals, pattern(vertices), photo, tick), lambda: texels.finished(mesh, tick)):
        left[0] = after
        with pytest.raises(InterruptedError):
            work()
    left[0] = min(after, 4)
    with pytest.raises(InterruptedError):
        texels.look(photo, found, tick)
