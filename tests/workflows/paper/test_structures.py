"""Dense voxels, hash map, octree and NerfTree: all give what a dict gives; the same in numba and in torch."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from workflows.paper.structures import bricks, torch_structures
from workflows.paper.structures.bricks import BrickTree, FullBricks
from workflows.paper.structures.dense import DenseVoxels
from workflows.paper.structures.hashing import HashMap
from workflows.paper.structures.octree import Octree
from workflows.paper.structures.synthetic import clustered, random_points, ray_points, scattered, shuffled
from workflows.paper.structures.voxels import Voxels

KERNELS = (DenseVoxels, HashMap, Octree, BrickTree, FullBricks)
TORCH = (torch_structures.DenseVoxels, torch_structures.HashMap, torch_structures.Octree, torch_structures.BrickTree, torch_structures.FullBricks)


def query(structure: type, voxels: Voxels, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cache and query; results overwrite garbage."""
    packed, occupied = np.full(len(points), 7, np.uint64), np.ones(len(points), bool)
    structure.cache(voxels).query(points, packed, occupied)
    return packed, occupied


def query_in_torch(structure: type, voxels: Voxels, points: np.ndarray, device: str = "cpu") -> tuple[np.ndarray, np.ndarray]:
    coordinates, packed = torch.from_numpy(voxels.coordinates).to(device), torch.from_numpy(voxels.packed.view(np.int64)).to(device)
    packed, occupied = structure.cache(voxels.side, coordinates, packed).query(torch.from_numpy(points).to(device))
    return packed.cpu().numpy().view(np.uint64), occupied.cpu().numpy()


def query_dict(voxels: Voxels, points: np.ndarray) -> np.ndarray:
    held = {tuple(at): word for at, word in zip(voxels.coordinates.tolist(), voxels.packed.tolist(), strict=True)}
    return np.array([held.get(tuple(math.floor(c) for c in p), 0) if np.isfinite(p).all() else 0 for p in points.tolist()], np.uint64)


@st.composite
def grids(draw: st.DrawFn) -> tuple[Voxels, np.ndarray]:
    """A grid of any share, listed in any order, and points in, on and beyond it."""
    side = draw(st.integers(1, 40))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    coordinates = np.argwhere(rng.random((side, side, side)) < draw(st.sampled_from([0, 0.001, 0.05, 0.2, 1]))).astype(np.int32)
    rng.shuffle(coordinates)
    values = rng.normal(size=(len(coordinates), 4)).astype(np.float16) + np.float16(9)
    points = rng.uniform(-1, side + 1, (300, 3)).astype(np.float32)
    points[:100] = np.round(points[:100])
    points[:6] = np.array([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf], [side, 0, 0], [-1e30, 0, 0], [-1e-30, 0, 0]], np.float32)
    return Voxels(side, coordinates, values.view(np.uint64)[:, 0]), points


@settings(max_examples=30, deadline=None)
@given(grids())
def test_every_structure_gives_what_a_dict_gives(case: tuple[Voxels, np.ndarray]) -> None:
    voxels, points = case
    expected = query_dict(voxels, points)
    for structure in KERNELS:
        packed, occupied = query(structure, voxels, points)
        np.testing.assert_array_equal(packed, expected, err_msg=str(structure))
        np.testing.assert_array_equal(occupied, expected != 0, err_msg=str(structure))
    for structure in TORCH:
        packed, occupied = query_in_torch(structure, voxels, points)
        np.testing.assert_array_equal(packed, expected, err_msg=str(structure))
        np.testing.assert_array_equal(occupied, expected != 0, err_msg=str(structure))


@pytest.mark.parametrize("make", [clustered, scattered])
def test_structures_agree_along_rays_of_a_larger_grid(make) -> None:  # type: ignore[no-untyped-def]
    voxels = make(70, 0.2, 3)
    points = np.concatenate([ray_points(70, 20_000, 1), random_points(70, 20_000, 2)])
    expected, occupied = query(DenseVoxels, voxels, points)
    assert 0.1 < occupied.mean() < 0.5
    for structure in KERNELS[1:]:
        for listed in (voxels, shuffled(voxels, 5)):
            np.testing.assert_array_equal(query(structure, listed, points)[0], expected, err_msg=str(structure))
    for structure in TORCH:
        np.testing.assert_array_equal(query_in_torch(structure, voxels, points)[0], expected, err_msg=str(structure))


@pytest.mark.gpu
@pytest.mark.parametrize("structure", TORCH)
def test_structures_agree_on_cuda(structure: type) -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device that torch can use")
    voxels, points = clustered(70, 0.2, 3), random_points(70, 20_000, 2)
    np.testing.assert_array_equal(query_in_torch(structure, voxels, points, "cuda")[0], query(DenseVoxels, voxels, points)[0])


def test_a_tree_of_bricks_takes_a_quarter_of_dense_voxels_at_a_fifth() -> None:
    for voxels in (clustered(128, 0.2, 0), scattered(128, 0.2, 0)):
        tree = BrickTree.cache(voxels)
        assert len(tree.values) == len(voxels.packed)
        assert 4 * sum(a.nbytes for a in tree.arrays.values()) < DenseVoxels.cache(voxels).grid.nbytes


@pytest.mark.parametrize("make", [clustered, scattered])
@pytest.mark.parametrize("share", [0, 0.05, 0.2, 1])
def test_shares_are_exact_and_repeat(make, share: float) -> None:  # type: ignore[no-untyped-def]
    voxels = make(33, share, 7)
    assert len(voxels.packed) == round(share * 33**3)
    order = (voxels.coordinates.astype(np.int64) * (33**2, 33, 1)).sum(axis=1)
    assert (np.diff(order) > 0).all()
    assert np.isfinite(voxels.packed.view(np.float16)).all()
    again = make(33, share, 7)
    np.testing.assert_array_equal(voxels.coordinates, again.coordinates)
    np.testing.assert_array_equal(voxels.packed, again.packed)


def test_rays_run_through_the_grid_one_voxel_at_a_time() -> None:
    points = ray_points(50, 30_000, 0)
    assert len(points) >= 30_000
    assert ((points >= 0) & (points < 50)).all()
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert np.median(steps) == pytest.approx(1, abs=1e-3)
    assert (steps > 2).mean() < 0.1  # where the next ray begins


def test_bricks_are_the_same_whichever_way_they_are_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    for voxels, apart in ((scattered(40, 0.2, 1), True), (clustered(40, 0.2, 1), False), (shuffled(clustered(40, 0.2, 1), 2), True)):
        assert bricks._is_scattered(voxels.coordinates) == apart
        made = []
        for way in (True, False):
            monkeypatch.setattr(bricks, "_is_scattered", lambda coordinates, way=way: way)
            made.append(bricks.BrickTree.cache(voxels).arrays)
        monkeypatch.undo()
        assert all(np.array_equal(made[0][name], made[1][name]) for name in made[0])
