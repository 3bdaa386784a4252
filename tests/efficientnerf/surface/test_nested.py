"""The surface of nested grids: a ball that reaches through several of them."""

import numpy as np
import pytest

from efficientnerf.asset.cascades import cascade_grids, cascades_of, nested
from efficientnerf.asset.tree import NerfTree, tree_from_voxels
from efficientnerf.surface import nested as nested_surface
from efficientnerf.surface.extraction import surface
from efficientnerf.surface.mesh import Mesh, face_areas, sampled
from efficientnerf.surface.nested import face_sizes, scene_surface
from efficientnerf.surface.volume import volume_of

VOXEL, SIGMA = 0.1, 60.0


def balls(*each: tuple[tuple[float, float, float], float], count: int = 3, half: float = 0.8) -> NerfTree:
    """Balls in nested grids, the inmost from -half to half."""
    bounds = np.array([[-half] * 3, [half] * 3])
    trees = []
    for number, (shape, voxel, low) in enumerate(cascade_grids(bounds, VOXEL, 4, count)):
        at = low + (np.argwhere(np.ones(np.array(shape) * 4, bool)) + 0.5) * voxel
        inside = np.zeros(len(at), bool)
        for centre, radius in each:
            inside |= np.linalg.norm(at - centre, axis=1) < radius
        if number:
            inside &= (np.abs(at) > half * 2 ** (number - 1) - 1.5 * voxel).any(axis=1)  # some voxels within the box before
        indices = np.argwhere(np.ones(np.array(shape) * 4, bool))[inside]
        sh = np.zeros((len(indices), 1, 3), np.float32)
        trees.append(tree_from_voxels(shape, voxel, low, indices, np.full(len(indices), SIGMA / 2**number, np.float32), sh, brick=4))
    return nested(trees)


def mesh_of(tree: NerfTree, threshold: float | None = None, faces: int = 20_000) -> Mesh:
    return scene_surface(tree, threshold, faces=faces, min_component=0.01, rounds=2, viewpoints=np.zeros((0, 3)), progress=lambda *_: None)


def _rays_that_pass(mesh: Mesh, origin: np.ndarray, directions: np.ndarray) -> float:
    """The share of rays that meet no face."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] - origin for k in range(3))
    hit = np.zeros(len(directions), bool)
    for n, ray in enumerate(directions):
        signs = np.stack([np.cross(p, q) @ ray for p, q in ((a, b), (b, c), (c, a))])
        hit[n] = (((signs >= 0).all(axis=0) | (signs <= 0).all(axis=0)) & ((a + b + c) @ ray > 0)).any()
    return float(1 - hit.mean())


def test_of_one_grid_it_is_the_surface_as_before() -> None:
    tree = balls(((0, 0, 0), 0.5), count=1)
    ours, before = mesh_of(tree), surface(volume_of(tree), None, faces=20_000, min_component=0.01, rounds=2)
    assert np.array_equal(ours.vertices, before.vertices)
    assert np.array_equal(ours.faces, before.faces)
    assert ours.facts == before.facts
    np.testing.assert_allclose(face_sizes(tree, ours.vertices, ours.faces), face_areas(ours.vertices, ours.faces) / VOXEL**2)


@pytest.mark.parametrize("threshold", [None, 25.0])
def test_a_ball_through_all_grids_has_one_surface_and_none_within(threshold: float | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its middle fills the inmost grid; its surface lies in the last two. Areas are those without flaps."""
    radius = 2.2
    tree = balls(((0, 0, 0), radius))
    directions = np.random.default_rng(0).normal(size=(500, 3))
    assert _rays_that_pass(mesh_of(tree, threshold), np.zeros(3), directions) == 0
    monkeypatch.setattr(nested_surface, "FACING", 0.0)
    mesh = mesh_of(tree, threshold)
    assert _rays_that_pass(mesh, np.zeros(3), directions) > 0.02
    away = np.linalg.norm(mesh.vertices, axis=1)
    side = 4 * VOXEL
    assert (np.abs(away - radius) < side).all()
    area = face_areas(mesh.vertices, mesh.faces).sum()
    assert 0.78 < area / (4 * np.pi * radius**2) < 1.05  # of voxels of 0.4 it is smaller, and there are cracks; lids would make it larger
    outward = (mesh.vertices * mesh.normals).sum(1) / away
    assert np.median(outward) > 0.95


def test_a_ball_across_the_border_of_two_grids_is_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    centre, radius = np.array([0.8, 0.0, 0.0]), 0.5
    tree = balls(((0.8, 0.0, 0.0), radius), count=2)
    mesh = mesh_of(tree, 20.0)
    assert (np.abs(np.linalg.norm(mesh.vertices - centre, axis=1) - radius) < 2.1 * VOXEL).all()
    middle = mesh.vertices[mesh.faces].mean(1)
    assert (middle[:, 0] < 0.8).any()
    assert (middle[:, 0] > 0.8).any()
    directions = np.random.default_rng(0).normal(size=(1500, 3))
    assert _rays_that_pass(mesh, centre, directions) < 0.002
    monkeypatch.setattr(nested_surface, "FACING", 0.0)
    assert _rays_that_pass(mesh_of(tree, 20.0), centre, directions) > 0.02


def test_points_thin_out_outwards() -> None:
    """As many to a voxel's face: of a ball in the inmost grid, and of one among voxels of four times the side."""
    tree = balls(((0, 0, 0), 0.5), ((0, 2.3, 0), 0.6))
    mesh = mesh_of(tree)
    near = np.linalg.norm(mesh.vertices[mesh.faces].mean(axis=1), axis=1) < 1
    areas, sizes = face_areas(mesh.vertices, mesh.faces), face_sizes(tree, mesh.vertices, mesh.faces)
    assert sizes[near].sum() / areas[near].sum() == pytest.approx(16 * sizes[~near].sum() / areas[~near].sum())
    cloud = sampled(mesh, 3001, 0, sizes)
    assert (np.linalg.norm(cloud.positions, axis=1) < 1).mean() == pytest.approx(sizes[near].sum() / sizes.sum(), abs=1e-3)


def test_nothing_is_found_twice_where_grids_overlap() -> None:
    tree = balls(((0.45, 0.3, 0.2), 0.2))
    mesh = mesh_of(tree)
    low, high = cascades_of(tree)[0].bounds(tree.brick)
    assert ((mesh.vertices > low) & (mesh.vertices < high)).all()
    assert mesh.facts["cascades"] == 1
