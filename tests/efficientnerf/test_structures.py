"""Dense voxels, hash map, octree and NerfTree: all give what a dict gives; the same in numba and in torch."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from efficientnerf.structures import bricks, on_device
from efficientnerf.structures.bricks import BrickTree, FullBricks
from efficientnerf.structures.dense import DenseVoxels
from efficientnerf.structures.hashing import HashMap
from efficientnerf.structures.occupancy import clustered, random_points, ray_points, scattered, shuffled
from efficientnerf.structures.octree import Octree
from efficientnerf.structures.voxels import Voxels, values_from_words, voxels_from_values, words_from_values

KERNELS = (DenseVoxels, HashMap, Octree, BrickTree, FullBricks)
TORCH = (on_device.DenseVoxels, on_device.HashMap, on_device.Octree, on_device.BrickTree, on_device.FullBricks)


def asked(structure: type, voxels: Voxels, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cache and query; the answers are written over noise."""
    words, found = np.full(len(points), 7, np.uint64), np.ones(len(points), bool)
    structure.cache(voxels).query(points, words, found)
    return words, found


def asked_in_torch(structure: type, voxels: Voxels, points: np.ndarray, device: str = "cpu") -> tuple[np.ndarray, np.ndarray]:
    coordinates, words = torch.from_numpy(voxels.coordinates).to(device), torch.from_numpy(voxels.words.view(np.int64)).to(device)
    words, found = structure.cache(voxels.side, coordinates, words).query(torch.from_numpy(points).to(device))
    return words.cpu().numpy().view(np.uint64), found.cpu().numpy()


def of_a_dict(voxels: Voxels, points: np.ndarray) -> np.ndarray:
    held = {tuple(at): word for at, word in zip(voxels.coordinates.tolist(), voxels.words.tolist(), strict=True)}
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
    return voxels_from_values(side, coordinates, values), points


@settings(max_examples=30, deadline=None)
@given(grids())
def test_every_structure_gives_what_a_dict_gives(case: tuple[Voxels, np.ndarray]) -> None:
    voxels, points = case
    expected = of_a_dict(voxels, points)
    for structure in KERNELS:
        words, found = asked(structure, voxels, points)
        np.testing.assert_array_equal(words, expected, err_msg=str(structure))
        np.testing.assert_array_equal(found, expected != 0, err_msg=str(structure))
    for structure in TORCH:
        words, found = asked_in_torch(structure, voxels, points)
        np.testing.assert_array_equal(words, expected, err_msg=str(structure))
        np.testing.assert_array_equal(found, expected != 0, err_msg=str(structure))


@pytest.mark.parametrize("make", [clustered, scattered])
def test_structures_agree_along_rays_of_a_larger_grid(make) -> None:  # type: ignore[no-untyped-def]
    voxels = make(70, 0.2, 3)
    points = np.concatenate([ray_points(70, 20_000, 1), random_points(70, 20_000, 2)])
    expected, found = asked(DenseVoxels, voxels, points)
    assert 0.1 < found.mean() < 0.5
    for structure in KERNELS[1:]:
        for listed in (voxels, shuffled(voxels, 5)):
            np.testing.assert_array_equal(asked(structure, listed, points)[0], expected, err_msg=str(structure))
    for structure in TORCH:
        np.testing.assert_array_equal(asked_in_torch(structure, voxels, points)[0], expected, err_msg=str(structure))


@pytest.mark.gpu
@pytest.mark.parametrize("structure", TORCH)
def test_structures_agree_on_cuda(structure: type) -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device that torch can use")
    voxels, points = clustered(70, 0.2, 3), random_points(70, 20_000, 2)
    np.testing.assert_array_equal(asked_in_torch(structure, voxels, points, "cuda")[0], asked(DenseVoxels, voxels, points)[0])


def test_more_points_than_one_part(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(on_device, "PART", 1000)
    voxels, points = clustered(32, 0.2, 0), random_points(32, 2500, 0)
    np.testing.assert_array_equal(asked_in_torch(on_device.BrickTree, voxels, points)[0], asked(DenseVoxels, voxels, points)[0])


def test_a_hash_map_stays_half_empty_and_an_octree_shares_its_rows() -> None:
    voxels = clustered(64, 0.2, 0)
    table = HashMap.cache(voxels).table
    assert np.count_nonzero(table[::2] != np.uint64(0xFFFFFFFFFFFFFFFF)) == len(voxels.words)
    assert len(table) // 2 >= 2 * len(voxels.words)
    tree = Octree.cache(voxels)
    assert len(tree.child) == len(tree.data)
    np.testing.assert_array_equal(np.sort(tree.data[tree.data != 0]), np.sort(voxels.words))
    inner = np.flatnonzero(tree.child)
    np.testing.assert_array_equal(np.sort(inner // 8 + tree.child[inner]), np.arange(1, len(tree.child) // 8))  # each node has one parent


def test_a_tree_of_bricks_takes_less_than_a_quarter_of_dense_voxels_at_a_fifth() -> None:
    for voxels in (clustered(128, 0.2, 0), scattered(128, 0.2, 0)):
        tree = BrickTree.cache(voxels)
        assert len(tree.values) == len(voxels.words)
        assert 4 * sum(a.nbytes for a in tree.arrays.values()) < DenseVoxels.cache(voxels).grid.nbytes


@pytest.mark.parametrize("make", [clustered, scattered])
@pytest.mark.parametrize("share", [0, 0.05, 0.2, 1])
def test_shares_are_exact_and_repeat(make, share: float) -> None:  # type: ignore[no-untyped-def]
    voxels = make(33, share, 7)
    assert len(voxels.words) == round(share * 33**3)
    order = (voxels.coordinates.astype(np.int64) * (33**2, 33, 1)).sum(axis=1)
    assert (np.diff(order) > 0).all()
    assert np.isfinite(voxels.values).all()
    again = make(33, share, 7)
    np.testing.assert_array_equal(voxels.coordinates, again.coordinates)
    np.testing.assert_array_equal(voxels.words, again.words)


def test_clusters_leave_most_bricks_empty_and_scattering_does_not() -> None:
    full, none = (len(np.unique(make(64, 0.2, 0).coordinates // 4, axis=0)) / 16**3 for make in (clustered, scattered))
    assert full < 0.4
    assert none > 0.99


def test_rays_run_through_the_grid_one_voxel_at_a_time() -> None:
    points = ray_points(50, 30_000, 0)
    assert len(points) >= 30_000
    assert ((points >= 0) & (points < 50)).all()
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert np.median(steps) == pytest.approx(1, abs=1e-3)
    assert (steps > 2).mean() < 0.1  # where the next ray begins


def test_words_carry_the_values() -> None:
    values = np.array([[1, -2, 0.5, 1e-3], [0, 0, 0, 6e-8]], np.float16)
    np.testing.assert_array_equal(values_from_words(words_from_values(values)), values)


@pytest.mark.parametrize(
    ("coordinates", "values", "message"),
    [
        ([[0, 0, 0], [0, 0, 0]], [[1, 1, 1, 1]] * 2, "listed twice"),
        ([[0, 0, 4]], [[1, 1, 1, 1]], "expected 0 to 3"),
        ([[0, -1, 0]], [[1, 1, 1, 1]], "expected 0 to 3"),
        ([[0, 0, 0]], [[0, 0, 0, 0]], "four zeros"),
        ([[0, 0]], [[1, 1, 1, 1]], r"expected \(N, 3\)"),
        ([[0, 0, 0]], [[1, 1, 1, 1]] * 2, r"\(N, 4\)"),
    ],
)
def test_lists_that_no_grid_has_are_refused(coordinates: list[list[int]], values: list[list[float]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        voxels_from_values(4, np.array(coordinates), np.array(values, np.float16))


def test_bricks_are_the_same_whichever_way_they_are_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    for voxels, apart in ((scattered(40, 0.2, 1), True), (clustered(40, 0.2, 1), False), (shuffled(clustered(40, 0.2, 1), 2), True)):
        assert bricks._lie_apart(voxels.coordinates) == apart
        made = []
        for way in (True, False):
            monkeypatch.setattr(bricks, "_lie_apart", lambda coordinates, way=way: way)
            made.append(bricks.BrickTree.cache(voxels).arrays)
        monkeypatch.undo()
        assert all(np.array_equal(made[0][name], made[1][name]) for name in made[0])
