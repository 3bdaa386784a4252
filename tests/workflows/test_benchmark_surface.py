"""benchmarks/surface.py: what it says of meshes whose errors are known, and a floor under what is meshed of a small made scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from benchmarks.scenes.catalogue import look_at
from benchmarks.scenes.shapes import Box, Capsule, Disc, Ground, Material, Shape, Sphere
from benchmarks.scenes.triangles import mesh_of, triangles
from benchmarks.surface import Surface, aligned, distances, footprint, image_scores, scores
from efficientnerf.asset.tree import tree_from_voxels
from efficientnerf.surface.extraction import surface
from efficientnerf.surface.volume import volume_of
from tests.still_life import true_mesh, write_mesh

GREY = Material(((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)))
CAMERAS = [look_at(f"{n}", 2.5 * np.array([np.cos(n), np.sin(n), 0.3 * (-1) ** n]), np.zeros(3), 64, 1.2) for n in range(8)]


def ball(radius: float, turned: bool = False) -> Surface:
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces)[:, ::-1] if turned else np.asarray(mesh.faces))


def test_a_ball_too_large_is_as_far_off_as_it_is_larger() -> None:
    found = scores(ball(0.512, turned=True), ball(0.5), CAMERAS, (0.005, 0.01, 0.02), samples=3000)
    assert (found.accuracy, found.completeness) == (pytest.approx(0.012, abs=1e-3), pytest.approx(0.012, abs=1e-3))
    assert (found.f[0.005], found.f[0.02], found.near) == (0.0, 1.0, 1.0)
    assert found.normals < 3
    assert footprint(CAMERAS, np.zeros(3)) == pytest.approx(2.5 * np.hypot(1, 0.3) / (1.2 * 64))
    rotation = trimesh.transformations.random_rotation_matrix(np.random.default_rng(1).random(3))[:3, :3]
    moved = 2.5 * ball(0.5).vertices @ rotation.T + [1, 2, 3]
    np.testing.assert_allclose(aligned(ball(0.5).vertices, moved).points(ball(0.5).vertices), moved, atol=1e-9)


def test_missing_parts_cost_completeness_and_unseen_ones_nothing() -> None:
    truth, inner = ball(0.5), ball(0.2)
    half = Surface(truth.vertices, truth.faces[truth.vertices[truth.faces].mean(1)[:, 2] > 0])
    found = scores(half, truth, CAMERAS, (0.005,), samples=3000)
    assert found.accuracy < 1e-3
    assert (found.precision[0.005], found.recall[0.005]) == (1.0, pytest.approx(0.5, abs=0.02))
    assert scores(half, truth, CAMERAS, (0.005,), region=lambda points: points[:, 2] > 0, samples=3000).recall[0.005] > 0.99
    images = image_scores(half, truth, CAMERAS)
    assert (images["added"], images["iou"]) == (0, pytest.approx(1 - images["missed"]))
    both = Surface(np.concatenate([truth.vertices, inner.vertices]), np.concatenate([truth.faces, inner.faces + len(truth.vertices)]))
    assert scores(both, truth, CAMERAS, (0.005,), samples=3000).accuracy < 1e-3


def test_distances_are_from_the_surface_not_from_its_samples() -> None:
    points = np.random.default_rng(0).normal(size=(300, 3))
    away, face = distances(points, ball(0.5), 4000)
    np.testing.assert_allclose(away, np.abs(np.linalg.norm(points, axis=1) - 0.5), atol=2e-3)
    assert face.max() < len(ball(0.5).faces)


@pytest.mark.parametrize(
    "shape",
    [Sphere((0.2, -0.1, 0.3), 0.5, GREY), Box((0.1, 0.2, -0.1), (0.3, 0.5, 0.2), GREY, heading=33.0), Capsule((-0.4, 0, 0), (0.3, 0.2, 0.4), 0.2, GREY),
     Disc((0.1, 0, 0.2), (1, 2, 3), 0.4, GREY), Ground(-0.3, GREY)],
    ids=["sphere", "box", "capsule", "disc", "ground"],
)  # fmt: skip
def test_triangles_lie_on_their_shape(shape: Shape) -> None:
    mesh = triangles(shape)
    points = np.asarray(mesh.triangles_center)
    normals = shape.normal(np.asarray(mesh.vertices)[np.asarray(mesh.faces)].mean(1))
    assert np.abs((np.asarray(mesh.face_normals) * normals).sum(1)).mean() > 0.97
    start = points + 0.05 * normals  # a ray back along the normal meets the shape there
    np.testing.assert_allclose(shape.hit(start, -normals), 0.05, atol=0.012)


def test_a_made_scene_s_mesh_keeps_its_floor() -> None:
    """A ball and a rod two voxels thick, from their own densities: all of it within a voxel, and the rod whole."""
    shapes: tuple[Shape, ...] = (Sphere((-0.3, 0.0, 0.0), 0.3, GREY), Capsule((0.4, 0.0, -0.5), (0.4, 0.3, 0.5), 0.03, GREY))
    cells, brick = 18, 4
    voxel = 2 / (cells * brick)
    index = np.stack(np.meshgrid(*[np.arange(cells * brick)] * 3, indexing="ij"), -1).reshape(-1, 3)
    centre = (index + 0.5) * voxel - 1
    a, b = np.array([0.4, 0.0, -0.5]), np.array([0.4, 0.3, 0.5])
    share = np.clip((centre - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)[:, None]
    distance = np.minimum(np.linalg.norm(centre - [-0.3, 0, 0], axis=1) - 0.3, np.linalg.norm(centre - a - share * (b - a), axis=1) - 0.03)
    kept = distance < voxel
    density = 400 * np.clip(0.5 - distance[kept] / voxel, 0, 1)
    tree = tree_from_voxels((cells,) * 3, voxel, np.full(3, -1.0), index[kept], density, np.zeros((int(kept.sum()), 1, 3), np.float32))
    mesh = surface(volume_of(tree))
    truth = mesh_of(shapes)
    real = Surface(np.asarray(truth.vertices), np.asarray(truth.faces))
    found = scores(Surface(mesh.vertices, mesh.faces), real, CAMERAS, (voxel / 2, voxel), samples=4000)
    images = image_scores(Surface(mesh.vertices, mesh.faces), real, CAMERAS)
    assert found.f[voxel] > 0.99
    assert found.f[voxel / 2] > 0.85
    assert found.normals < 9
    assert images["iou"] > 0.85


def test_the_true_mesh_of_the_still_life_is_whole(tmp_path: Path) -> None:
    mesh = true_mesh()
    assert (len(mesh.vertices), len(mesh.faces), mesh.faces.max()) == (14_316, 28_680, 14_315)
    assert len(mesh.split(only_watertight=False)) == 84
    table = np.isclose(mesh.vertices[:, 2], 0, atol=2e-5)
    assert np.unique(mesh.vertices[table, 2]).size == 1  # what is flat stays flat
    write_mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), tmp_path / "a.npz")
    again = true_mesh(tmp_path / "a.npz")
    assert np.array_equal(again.faces, mesh.faces)
    np.testing.assert_allclose(again.vertices, mesh.vertices, atol=2 / 65535 * 0.51)
