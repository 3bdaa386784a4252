"""Surfaces of forward-facing trees: a slanted wall and its points land where they are in the world, coloured as they were seen; the backdrop stays out."""

from dataclasses import replace

import numpy as np
import pytest

from efficientnerf.asset.rendering import render_rays
from efficientnerf.asset.tree import NerfTree
from efficientnerf.surface.extraction import surface
from efficientnerf.surface.isosurface import NoSurface
from efficientnerf.surface.mesh import sampled, topology
from efficientnerf.surface.nested import face_sizes
from efficientnerf.surface.volume import volume_of
from tests.efficientnerf.walls import DEPTH, NEAR, wall

SLANT = 0.3


def marched() -> NerfTree:
    """A wall that reaches to the sides of the box, soft; the depth of the level is known."""
    tree = wall(SLANT, voxels=96, hard=1.0, degree=2)
    return replace(tree, metadata={"spiral": {"radii": [0.5, 0.3, 0.1], "focus": 6.0, "tangents": [0.5, 0.5], "far": 40.0}})


def local(tree: NerfTree, world: np.ndarray) -> np.ndarray:
    return (world - tree.ndc.world_from_camera[:3, 3]) @ tree.ndc.world_from_camera[:3, :3]


def level_depth(tree: NerfTree, level: float, x: np.ndarray) -> np.ndarray:
    """Depth of the surface where the density passes `level`, at x: z (1/D - c / 2n) + s x / D ... solved for z; c the z' between front and level."""
    behind = level * tree.voxel**2
    return np.asarray((1 + SLANT * x / DEPTH) / (1 / DEPTH - behind / (2 * NEAR)))


def test_a_wall_s_mesh_lies_where_the_wall_is() -> None:
    tree = marched()
    level = 3.0 / tree.voxel
    mesh = surface(volume_of(tree), level, rounds=0, faces=20_000)
    assert topology(mesh.vertices, mesh.faces).watertight
    assert np.isfinite(mesh.vertices).all()
    at = local(tree, mesh.vertices)
    normal = local(tree, mesh.normals + tree.ndc.world_from_camera[:3, 3])  # type: ignore[union-attr]
    middle = (np.abs(at[:, :2]) < 2.0).all(1)
    front = middle & (normal[:, 2] < -0.8)
    assert front.sum() > 200
    expected = level_depth(tree, level, at[front, 0])
    np.testing.assert_allclose(at[front, 2], expected, atol=0.5 * DEPTH**2 / (2 * NEAR) * tree.voxel)
    assert np.median(np.abs(at[front, 2] - expected)) < 0.05
    slope = SLANT * expected / (DEPTH + SLANT * at[front, 0])
    facing = np.stack([slope, 0 * slope, -np.ones_like(slope)], -1)
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    assert np.median((normal[front] * facing).sum(1)) > 0.99


def test_colours_are_those_that_the_cameras_saw() -> None:
    tree = marched()
    mesh = surface(volume_of(tree), 3.0 / tree.voxel, rounds=0, faces=20_000)
    at = local(tree, mesh.vertices)
    middle = np.flatnonzero((np.abs(at[:, :2]) < 1.0).all(1) & (at[:, 2] < DEPTH + 3))[:50]
    away = at[middle] @ tree.ndc.world_from_camera[:3, :3].T  # type: ignore[union-attr]
    seen = render_rays(tree, np.broadcast_to(tree.ndc.world_from_camera[:3, 3], away.shape), away / np.linalg.norm(away, axis=1, keepdims=True))  # type: ignore[union-attr]
    np.testing.assert_allclose(mesh.colours[middle], seen.colour / seen.opacity[:, None], atol=0.03)


def test_points_lie_on_the_wall_and_are_as_dense_in_images_at_any_depth() -> None:
    tree = marched()
    level = 3.0 / tree.voxel
    mesh = surface(volume_of(tree), level, rounds=0)
    cloud = sampled(mesh, 20_000, 0, face_sizes(tree, mesh.vertices, mesh.faces))
    at, normal = local(tree, cloud.positions), local(tree, cloud.normals + tree.ndc.world_from_camera[:3, 3])  # type: ignore[union-attr]
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-6)
    front = (np.abs(at[:, :2]) < 2.0).all(1) & (normal[:, 2] < -0.8)
    assert np.median(np.abs(at[front, 2] - level_depth(tree, level, at[front, 0]))) < 0.05
    image = at[normal[:, 2] < -0.5, :2] / at[normal[:, 2] < -0.5, 2:]
    counts = np.histogram(image[np.abs(image[:, 1]) < 0.2, 0], 4, (-0.3, 0.3))[0]
    assert counts.min() > 200
    assert np.ptp(counts) < 0.15 * counts.mean()


def test_the_backdrop_is_left_out() -> None:
    tree = marched()
    beyond = replace(tree, metadata={"spiral": {**tree.metadata["spiral"], "far": DEPTH + 1.5}})
    level = 3.0 / tree.voxel
    at = local(tree, surface(volume_of(beyond), level, rounds=0).vertices)
    assert at[:, 2].max() < DEPTH + 1.5 + 1e-6
    with pytest.raises(NoSurface):
        surface(volume_of(replace(tree, metadata={"spiral": {**tree.metadata["spiral"], "far": 3.0}})), level)
