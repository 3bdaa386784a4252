"""Dense voxels, hash map, octree and NerfTree: all give what a dict gives."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.paper.structures import BrickTree, DenseVoxels, FullBricks, HashMap, Octree, Structure
from benchmarks.paper.voxels import Voxels, clustered, random_points

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


@pytest.mark.gpu
@pytest.mark.parametrize("structure", STRUCTURES)
def test_structures_agree_on_cuda(structure: type[Structure]) -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device that torch can use")
    voxels, points = clustered(70, 0.2, 3), random_points(70, 20_000, 2)
    np.testing.assert_array_equal(query(structure, voxels, points, "cuda"), query(DenseVoxels, voxels, points))
