"""Surfaces moved to the silhouettes of their assets: balls, wires and boxes whose silhouettes are known."""

import numpy as np
import pytest
import trimesh

from efficientnerf.geometry.cameras import Camera
from efficientnerf.surface.agreement import AssetView, agreement
from efficientnerf.surface.fitting.silhouettes import distance_inside, fitted_to_silhouettes
from efficientnerf.surface.rasteriser import mesh_image
from tests.poses import looking_at

PIXEL = 3.0 / 140  # at the origin


def cameras(count: int = 24) -> list[Camera]:
    """All around the origin, three away."""
    out = []
    for n in range(count):
        height, turn = 1.6 * (n + 0.5) / count - 0.8, 2.4 * n
        centre = 3 * np.array([np.sqrt(1 - height**2) * np.cos(turn), np.sqrt(1 - height**2) * np.sin(turn), height])
        out.append(Camera(f"c{n}", 120, 110, "SIMPLE_PINHOLE", (140.0, 60.0, 55.0), looking_at(centre)))
    return out


def views_of(mesh: trimesh.Trimesh) -> list[AssetView]:
    """An opaque asset of this shape."""
    out = []
    for camera in cameras():
        image = mesh_image(np.asarray(mesh.vertices), np.asarray(mesh.faces), camera)
        out.append(AssetView(camera, image.covered.astype(np.float32), image.depth))
    return out


def fitted(mesh: trimesh.Trimesh, views: list[AssetView]) -> trimesh.Trimesh:
    return trimesh.Trimesh(fitted_to_silhouettes(np.asarray(mesh.vertices), np.asarray(mesh.faces), views), mesh.faces, process=False)


@pytest.mark.parametrize("radius", [0.08, 0.1, 0.12])
def test_a_small_ball_gets_the_size_that_its_asset_has(radius: float) -> None:
    found = fitted(trimesh.creation.icosphere(2, radius=radius), views_of(trimesh.creation.icosphere(4, radius=0.1)))
    away = np.linalg.norm(found.vertices, axis=1)
    assert away.mean() == pytest.approx(0.1, abs=0.25 * PIXEL)
    assert away.std() < 0.25 * PIXEL


def test_a_wire_gets_as_thick_as_it_is() -> None:
    def wire(radius: float) -> trimesh.Trimesh:
        mesh = trimesh.creation.cylinder(radius, 1.0, sections=24)
        for _ in range(3):
            mesh = mesh.subdivide()
        return mesh

    views = views_of(wire(0.05))
    thin = wire(0.025)
    found = fitted(thin, views)

    def missed(mesh: trimesh.Trimesh) -> float:
        return agreement(views, [mesh_image(np.asarray(mesh.vertices), np.asarray(mesh.faces), view.camera) for view in views]).missed

    assert missed(thin) > 0.2
    assert missed(found) < 0.4 * missed(thin)
    assert np.linalg.norm(found.vertices[:, :2], axis=1).max() < 0.05 + 0.5 * PIXEL


def test_a_surface_with_its_assets_silhouettes_stays() -> None:
    box = trimesh.creation.box((0.8, 0.6, 0.5))
    for _ in range(4):
        box = box.subdivide()
    found = fitted(box, views_of(box))
    assert np.abs(found.vertices - box.vertices).max() < 0.3 * PIXEL
    assert np.linalg.norm(found.vertices - box.vertices, axis=1).mean() < 0.05 * PIXEL


def test_what_ends_in_no_view_stays() -> None:
    """Views that are opaque all over, or empty; and an edge of the asset that is another's, far from the surface's."""
    ball = trimesh.creation.icosphere(2, radius=0.1)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    whole = [AssetView(camera, np.full((camera.height, camera.width), share, np.float32), np.full((camera.height, camera.width), 3.0, np.float32))
             for camera in cameras(4) for share in (1.0, 0.0)]  # fmt: skip
    np.testing.assert_array_equal(fitted_to_silhouettes(vertices, faces, whole), vertices)
    np.testing.assert_array_equal(fitted_to_silhouettes(vertices, faces, views_of(trimesh.creation.icosphere(4, radius=0.3))), vertices)
    np.testing.assert_array_equal(fitted_to_silhouettes(vertices, faces, []), vertices)


def test_distances_are_exact_and_repeat() -> None:
    """To the nearest pixel of the other kind; OpenCV's own differ in the last bit from call to call."""
    mask = np.random.default_rng(0).random((24, 30)) > 0.3
    mask[4:16, 5:20] = True
    rows, columns = np.indices(mask.shape)
    wanted = np.empty(mask.shape)
    for row, column in np.ndindex(mask.shape):
        squared = (rows - row) ** 2 + (columns - column) ** 2
        other = np.sqrt(squared[mask != mask[row, column]].min())
        wanted[row, column] = other - 0.5 if mask[row, column] else 0.5 - other
    found = distance_inside(mask)
    np.testing.assert_array_equal(found, wanted.astype(np.float32))
    for _ in range(20):
        np.testing.assert_array_equal(distance_inside(mask), found)
    assert distance_inside(np.ones((3, 3), bool)) is distance_inside(np.zeros((3, 3), bool)) is None
