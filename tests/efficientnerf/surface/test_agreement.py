"""A surface against views of an asset: balls whose silhouettes are known."""

import numpy as np
import pytest
import trimesh

from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.surface.agreement import AssetView, agreement, shown_pixels
from efficientnerf.surface.rasteriser import mesh_image

VOXEL = 0.02


def view(radius: float, opacity: float = 1.0) -> AssetView:
    """A ball round the origin, as its rays say."""
    pose = np.eye(4)
    pose[2, 3] = -3.0
    camera = Camera("c", 60, 50, "SIMPLE_PINHOLE", (70.0, 30.0, 25.0), pose)
    origins, directions = rays(camera)
    along = -(origins * directions).sum(1)
    left = radius**2 - ((origins**2).sum(1) - along**2)
    depth = np.where(left > 0, (along - np.sqrt(np.maximum(left, 0))) * directions[:, 2], np.inf)
    share = np.where(left > 0, opacity, 0.0)
    shape = camera.height, camera.width
    return AssetView(camera, share.reshape(shape).astype(np.float32), np.where(share >= 0.5, depth, np.inf).reshape(shape).astype(np.float32))


def ball(radius: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return np.asarray(mesh.vertices) + centre, np.asarray(mesh.faces)


def joined(*parts: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    vertices, faces, component, first = [], [], [], 0
    for number, (places, triangles) in enumerate(parts):
        vertices.append(places)
        faces.append(triangles + first)
        component.append(np.full(len(triangles), number))
        first += len(places)
    return np.concatenate(vertices), np.concatenate(faces), np.concatenate(component)


@pytest.mark.parametrize("radius", [0.5, 0.6, 0.7])
def test_missed_and_added_are_the_areas_of_the_silhouettes(radius: float) -> None:
    views = [view(0.6)]
    found = agreement(views, [mesh_image(*ball(radius), views[0].camera)])
    own, true = (r**2 / (9 - r**2) for r in (radius, 0.6))  # a ball's silhouette is a circle of this squared radius
    assert found.iou == pytest.approx(min(own, true) / max(own, true), abs=0.03)
    assert found.missed == pytest.approx(max(0, 1 - own / true), abs=0.03)
    assert found.added == pytest.approx(max(0, 1 - true / own), abs=0.03)
    assert abs(radius - 0.6) / 2.6 <= found.depth + 1e-3 <= abs(radius - 0.6) / 1.8 + 2e-3  # more at a slant


def test_what_the_asset_shows_is_seen_however_small_and_the_rest_is_not() -> None:
    small, before, hidden = ball(0.03, (0.0, 0.0, -0.6)), ball(0.1, (0.0, 0.0, -1.4)), ball(0.2)
    aside = ball(0.2, (0.9, 0.0, 0.0))
    seen = shown_pixels(*joined(ball(0.6), small, hidden, aside), [view(0.6)], VOXEL)
    assert seen[0] > 100
    assert 1 <= seen[1] < 12
    assert seen[2] == seen[3] == 0  # within the ball; and beside it, where the asset shows nothing
    floating = shown_pixels(*joined(ball(0.6), before), [view(0.6)], VOXEL)
    assert floating[1] == 0  # in front of what the asset shows
