"""Tangents, and normal maps baked from dense meshes: what is decoded as a viewer decodes it is the dense mesh's normal."""

from dataclasses import replace

import numpy as np
import pytest

from efficientnerf.surface.mesh import Mesh, Texture, face_vectors, vertex_normals
from efficientnerf.surface.texturing.atlas import Atlas, Texels, atlas_of
from efficientnerf.surface.texturing.normal_map import Dense, corner_frames, normals_in_tangent_space, with_normal_map
from efficientnerf.surface.texturing.tangents import tangents
from tests.efficientnerf.surface.texturing.shapes import ball, box

SIZE = 128


def textured(vertices: np.ndarray, faces: np.ndarray, *, mirrored: bool = False) -> tuple[Mesh, Texels]:
    """With an atlas, its texels; mirrored: u to the left, so that bitangents turn round."""
    corners = atlas_of(vertices, faces, np.inf, SIZE).corners
    if mirrored:
        corners = np.stack([SIZE - corners[..., 0], corners[..., 1]], -1)
    atlas = Atlas(corners, np.zeros(len(faces), np.int64), SIZE, 1.0)
    texture = Texture(atlas.coordinates, np.zeros((SIZE, SIZE, 3), np.uint8))
    return Mesh(vertices, faces, vertex_normals(vertices, faces), np.zeros((len(vertices), 3), np.float32), texture=texture), atlas.texels


def decoded(mesh: Mesh, texels: Texels, pixels: np.ndarray) -> np.ndarray:
    """(T, 3) unit normals as a viewer has them: the picture in the interpolated frame."""
    split, frame = corner_frames(mesh)
    normal, tangent = texels.values(mesh.normals, mesh.faces), texels.values(frame[:, :3], split)
    sign = frame[split[texels.face, 0], 3:]
    x, y, z = (pixels / 127.5 - 1).T[..., None]
    found = x * tangent + y * sign * np.cross(normal, tangent) + z * normal
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def degrees(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((one * other).sum(1), -1, 1)))


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_few_faces_are_as_round_as_the_ball_they_were_made_of(mirrored: bool) -> None:
    mesh, texels = textured(*ball(1), mirrored=mirrored)
    bent = mesh.normals + 0.1 * np.random.default_rng(0).standard_normal(mesh.normals.shape)
    mesh = replace(mesh, normals=bent / np.linalg.norm(bent, axis=1, keepdims=True))
    pixels, met = normals_in_tangent_space(mesh, texels, Dense(*ball(5)), lambda: None)
    point = texels.values(mesh.vertices, mesh.faces)
    round_ = point / np.linalg.norm(point, axis=1, keepdims=True)
    own = texels.values(mesh.normals, mesh.faces)
    assert met.all()
    assert degrees(decoded(mesh, texels, pixels), round_).max() < 2
    assert degrees(own / np.linalg.norm(own, axis=1, keepdims=True), round_).mean() > 4
    assert corner_frames(mesh)[1][:, 3].mean() == (1 if mirrored else -1)


def test_a_mesh_baked_from_itself_is_flat() -> None:
    vertices, faces = box()
    mesh, texels = textured(vertices, faces)
    pixels, met = normals_in_tangent_space(mesh, texels, Dense(vertices, faces), lambda: None)
    assert met.all()
    assert np.abs(pixels.astype(int) - [128, 128, 255]).max() <= 1


def test_relief_stands_where_it_is_and_the_right_way_up() -> None:
    """A dense plane with a ridge along x, over one with two faces: on the side where y is less the ridge looks to -y. Green is up in the picture."""
    side = np.linspace(0, 1, 101)
    x, y = np.meshgrid(side, side, indexing="ij")
    dense = np.stack([x, y, 0.05 * np.maximum(0, 1 - np.abs(y - 0.5) / 0.2)], -1).reshape(-1, 3)
    corner = (np.arange(100)[:, None] * 101 + np.arange(100)).reshape(-1, 1)
    quads = corner + np.array([0, 101, 102, 1])
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    two = np.array([[0, 1, 2], [0, 2, 3]])
    mesh = Mesh(flat, two, np.tile([0.0, 0, 1], (4, 1)), np.zeros((4, 3), np.float32), texture=Texture(flat[two][..., :2], np.zeros((64, 64, 3), np.uint8)))
    found = with_normal_map(mesh, Dense(dense, faces))
    assert found.facts["normal_map_met"] == 1
    rows = found.texture.normals[:, 8:-8].astype(int)  # row 0 is y = 1
    slope = 127.5 * (1 + np.array([0, 0.25, 1]) / np.linalg.norm([0, 0.25, 1]))
    np.testing.assert_allclose(rows[23:30].mean((0, 1)), slope, atol=3)
    np.testing.assert_allclose(rows[34:41].mean((0, 1)), slope * [1, -1, 1] + [0, 255, 0], atol=3)
    assert np.abs(rows[:16] - [128, 128, 255]).max() <= 1


def test_what_is_out_of_reach_or_looks_away_is_flat() -> None:
    vertices, faces = ball(2)
    mesh, texels = textured(vertices, faces)
    large, fine = ball(5)
    for dense in (Dense(2 * large, fine), Dense(large, fine[:, ::-1].copy())):
        pixels, met = normals_in_tangent_space(mesh, texels, dense, lambda: None)
        assert not met.any()
        assert np.abs(pixels.astype(int) - [128, 128, 255]).max() <= 1


def test_tangents_point_where_u_grows_and_bitangents_where_v_does() -> None:
    rng = np.random.default_rng(1)
    for turn in (1.0, -1.0):
        u, v = np.linalg.qr(rng.standard_normal((3, 3)))[0][:2]
        places = np.array([[0.0, 0], [0.5, 0], [0.5, 0.3], [0, 0.3]])
        vertices = places[:, :1] * u + turn * places[:, 1:] * v
        faces = np.array([[0, 1, 2], [0, 2, 3]]) if turn > 0 else np.array([[0, 2, 1], [0, 3, 2]])
        normal = face_vectors(vertices, faces)[0]
        normals = np.tile(normal / np.linalg.norm(normal), (4, 1))
        found = tangents(vertices, normals, places, faces)
        np.testing.assert_allclose(found[:, :3], np.tile(u, (4, 1)), atol=1e-12)
        np.testing.assert_allclose(found[:, 3:] * np.cross(normals, found[:, :3]), np.tile(turn * v, (4, 1)), atol=1e-12)
