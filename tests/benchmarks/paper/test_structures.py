"""Dense voxels, hash map, octree and NerfTree: all give what a dict gives."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.paper.structures import BrickTree, DenseVoxels, FullBricks, HashMap, Octree, Structure
from benchmarks.paper.voxels import Voxels, clustered, random_points, ray_points, scattered

STRUCTURES = (DenseVoxels, HashMap, Octree, BrickTree, FullBricks)


def cached(structure: type[Structure], voxels: Voxels, device: str = "cpu") -> Structure:
    return structure.cache(voxels.side, torch.from_numpy(voxels.coordinates).to(device), torch.from_numpy(voxels.packed).to(device))


def query(structure: type[Structure], voxels: Voxels, points: np.ndarray, device: str = "cpu") -> np.ndarray:
    return cached(structure, voxels, device).query(torch.from_numpy(points).to(device)).cpu().numpy()


def query_dict(voxels: Voxels, points: np.ndarray) -> np.ndarray:
    held = {tuple(at): word for at, word in zip(voxels.coordinates.tolist(), voxels.packed.tolist(), strict=True)}
    return np.array([held.get(tuple(math.floor(c) for c in p), 0) if np.isfinite(p).all() else 0 for p in points.tolist()], np.int64)


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
    return Voxels(side, coordinates, values.view(np.int64)[:, 0]), points


@settings(max_examples=30, deadline=None)
@given(grids())
def test_every_structure_gives_what_a_dict_gives(case: tuple[Voxels, np.ndarray]) -> None:
    voxels, points = case
    expected = query_dict(voxels, points)
    for structure in STRUCTURES:
        np.testing.assert_array_equal(query(structure, voxels, points), expected, err_msg=str(structure))


@pytest.mark.parametrize("make", [clustered, scattered])
def test_structures_agree_along_rays_of_a_larger_grid(make) -> None:  # type: ignore[no-untyped-def]
    voxels = make(70, 0.2, 3)
    points = np.concatenate([ray_points(70, 20_000, 1), random_points(70, 20_000, 2)])
    expected = query(DenseVoxels, voxels, points)
    assert 0.1 < (expected != 0).mean() < 0.5
    for structure in STRUCTURES[1:]:
        np.testing.assert_array_equal(query(structure, voxels, points), expected, err_msg=str(structure))


@pytest.mark.gpu
@pytest.mark.parametrize("structure", STRUCTURES)
def test_structures_agree_on_cuda(structure: type[Structure]) -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device that torch can use")
    voxels, points = clustered(70, 0.2, 3), random_points(70, 20_000, 2)
    np.testing.assert_array_equal(query(structure, voxels, points, "cuda"), query(DenseVoxels, voxels, points))


def test_a_tree_of_bricks_takes_a_quarter_of_dense_voxels_at_a_fifth() -> None:
    for voxels in (clustered(128, 0.2, 0), scattered(128, 0.2, 0)):
        tree = cached(BrickTree, voxels)
        assert len(tree.tensors["values"]) == len(voxels.packed)
        assert 4 * sum(tensor.nbytes for tensor in tree.tensors.values()) < 8 * voxels.side**3


@pytest.mark.parametrize("make", [clustered, scattered])
@pytest.mark.parametrize("share", [0, 0.05, 0.2, 1])
def test_shares_are_exact_and_repeat(make, share: float) -> None:  # type: ignore[no-untyped-def]
    voxels = make(33, share, 7)
    assert len(voxels.packed) == round(share * 33**3)
    order = (voxels.coordinates.astype(np.int64) * (33**2, 33, 1)).sum(axis=1)
    assert (np.diff(order) > 0).all()
    assert np.isfinite(voxels.packed.view(np.float16)).all()
    assert len(np.unique(voxels.packed)) == len(voxels.packed)
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
