"""The level at which a surface has its asset's silhouettes: soft and hard balls, in the world."""

import numpy as np
import pytest

from efficientnerf.asset.tree import NerfTree, tree_from_voxels
from efficientnerf.geometry.cameras import Camera, rays
from efficientnerf.surface.agreement import AssetView, agreement, asset_view
from efficientnerf.surface.isosurface import automatic_threshold, isosurface
from efficientnerf.surface.level import silhouette_level, surfaces_met
from efficientnerf.surface.rasteriser import mesh_image
from efficientnerf.surface.volume import volume_of

RADIUS, CELLS, BRICK = 0.5, 8, 4


def ball(softness: float, density: float) -> NerfTree:
    """A ball whose density falls from its middle of a border of this width, voxels."""
    side = CELLS * BRICK
    voxel = 2 / side
    index = np.argwhere(np.ones((side,) * 3, bool))
    distance = np.linalg.norm((index + 0.5) * voxel - 1, axis=1) - RADIUS
    values = density * np.clip(0.5 - distance / (softness * voxel), 0, 1)
    kept = values > 0
    return tree_from_voxels((CELLS,) * 3, voxel, np.full(3, -1.0), index[kept], values[kept], np.zeros((int(kept.sum()), 1, 3), np.float32))


def views(tree: NerfTree) -> list[AssetView]:
    out = []
    for turn in (0.0, 0.7):
        pose = np.eye(4)
        pose[:3, :3] = [[np.cos(turn), 0, -np.sin(turn)], [0, 1, 0], [np.sin(turn), 0, np.cos(turn)]]
        pose[:3, 3] = -3 * pose[:3, 2]
        out.append(asset_view(tree, Camera("c", 90, 80, "SIMPLE_PINHOLE", (110.0, 45.0, 40.0), pose)))
    return out


@pytest.mark.parametrize(("softness", "density"), [(1.0, 100.0), (4.0, 60.0), (8.0, 20.0)])
def test_the_surface_has_the_silhouettes_of_the_asset(softness: float, density: float) -> None:
    tree = ball(softness, density)
    seen, highest = views(tree), automatic_threshold(volume_of(tree))
    found = silhouette_level(tree, seen, highest, lambda: None)

    def iou(level: float) -> float:
        vertices, faces = isosurface(volume_of(tree), level)
        return agreement(seen, [mesh_image(vertices, faces, view.camera) for view in seen]).iou

    assert iou(found) > 0.95
    assert iou(found) >= max(iou(found * 2), iou(found / 2)) - 0.005


def test_a_ray_meets_the_surface_that_the_mesh_has() -> None:
    tree = ball(4.0, 60.0)
    levels = np.array([40.0, 10.0, 2.0])
    camera = views(tree)[1].camera
    met = surfaces_met(tree, *rays(camera), levels)
    for number, level in enumerate(levels):
        image = mesh_image(*isosurface(volume_of(tree), level), camera)
        assert (met[:, number] != image.covered.ravel()).mean() < 0.005
        assert image.covered.any()
