"""From floats to codes, and the layouts that hold them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from efficientnerf.asset import format
from efficientnerf.asset.format import WRITERS, describe, load, save
from efficientnerf.asset.palettes import PaletteHarmonics
from efficientnerf.asset.queries import density_at
from efficientnerf.asset.rendering import render_rays
from efficientnerf.asset.tree import NerfTree, tree_from_voxels
from efficientnerf.backends.numba import kmeans
from tests.efficientnerf.trees import LOW, random_tree, rays_at


def smooth_tree(size: int = 24, degree: int = 2, sigma: float = 300.0) -> NerfTree:
    """A ball whose colour turns with the place and with the direction: values as different as voxels are, but not noise."""
    at = np.argwhere(np.ones((size,) * 3, bool))
    place = (at + 0.5) / size * 2 - 1
    inside = np.linalg.norm(place, axis=1)
    kept = inside < 0.9
    place, at = place[kept], at[kept]
    density = (sigma * np.clip(0.8 - inside[kept], 0, None)).astype(np.float32)
    rng = np.random.default_rng(0)
    waves = rng.normal(size=(3, (degree + 1) ** 2 * 3))
    sh = np.sin(3 * place @ waves).reshape(len(at), -1, 3) * np.where(np.arange((degree + 1) ** 2) == 0, 3.0, 0.5)[:, None]
    return tree_from_voxels((size // 4,) * 3, 2 / size, -np.ones(3), at, density, sh.astype(np.float32))


def seen(tree: NerfTree) -> np.ndarray:
    return render_rays(tree, *rays_at(tree, 2000)).colour


# k-means


@pytest.mark.parametrize(("count", "size", "entries"), [(1, 1, 1), (200, 3, 7), (130, 24, 64), (64, 9, 300), (5000, 3, 5)])
def test_the_nearest_is_the_nearest(count: int, size: int, entries: int) -> None:
    rng = np.random.default_rng(count)
    vectors, centroids = rng.normal(size=(count, size)).astype(np.float32), rng.normal(size=(entries, size)).astype(np.float32)
    found, distance = np.zeros(count, np.int32), np.zeros(count, np.float32)
    kmeans.nearest_centroids(np.ascontiguousarray(vectors.T), centroids, found, distance)
    squared = ((vectors[:, None].astype(np.float64) - centroids) ** 2).sum(2)
    assert np.array_equal(found, squared.argmin(1))
    np.testing.assert_allclose(distance, squared.min(1), rtol=1e-5, atol=1e-6)
    total, number = np.zeros((entries, size)), np.zeros(entries, np.int64)
    kmeans.sum_clusters(vectors, found, total, number)
    for p in range(entries):
        assert number[p] == (found == p).sum()
        np.testing.assert_allclose(total[p], vectors[found == p].sum(0, dtype=np.float64), atol=1e-9)
    approached = np.full(count, 1.0, np.float32)
    kmeans.lower_distances(np.ascontiguousarray(vectors.T), centroids[0], approached)
    np.testing.assert_allclose(approached, np.minimum(squared[:, 0], 1), rtol=1e-5, atol=1e-6)


# Layouts


@pytest.mark.parametrize(("layout", "most"), [("compact", 0.003), ("packed", 0.003), ("small", 0.01), ("sparse", 0.0005), ("full", 0.003), ("full32", 0.003)])
def test_a_layout_shows_the_same(tmp_path: Path, layout: str, most: float) -> None:
    tree = smooth_tree()
    save(tree, tmp_path / "a.nerftree", layout)
    again = load(tmp_path / "a.nerftree")
    error = np.sqrt(((seen(again) - seen(tree)) ** 2).mean())
    assert error < most, f"{layout}: {error}"
    format.save(again, tmp_path / "b.nerftree", layout)
    assert (tmp_path / "a.nerftree").read_bytes() == (tmp_path / "b.nerftree").read_bytes()


def test_a_compact_file_is_small_and_stays_small_in_memory(tmp_path: Path) -> None:
    tree = smooth_tree(32)
    for layout, a_voxel in (("compact", 12), ("small", 6), ("sparse", 56)):
        save(tree, tmp_path / "a.nerftree", layout)
        about = describe(tmp_path / "a.nerftree")
        assert about["bytes_per_voxel"] == a_voxel
        assert about["voxels"] == len(tree.density_values)
    coded = load(tmp_path / "a.nerftree").harmonics
    assert isinstance(coded, np.ndarray)
    save(tree, tmp_path / "a.nerftree", "compact")
    held = load(tmp_path / "a.nerftree").harmonics
    assert isinstance(held, PaletteHarmonics)
    assert held.base.nbytes + held.codes.nbytes == 11 * len(tree.density_values)


def test_full_bricks_hold_what_was_stored_and_zero_density_beside_it(tmp_path: Path) -> None:
    tree = random_tree(2, degree=1)
    save(tree, tmp_path / "a.nerftree", "full32")
    full = load(tmp_path / "a.nerftree")
    assert (full.voxel_index >= 0).all()
    stored = tree.voxel_index >= 0
    assert np.array_equal(full.density_values[full.voxel_index[stored]], tree.density_values[tree.voxel_index[stored]])
    assert np.array_equal(full.sh[full.voxel_index[stored]], tree.sh[tree.voxel_index[stored]])
    assert not full.density_values[full.voxel_index[~stored]].any()
    for brick in range(len(tree.voxel_index)):
        inside = tree.sh[tree.voxel_index[brick][stored[brick]]]
        filled = full.sh[full.voxel_index[brick][~stored[brick]]]
        assert len(inside) == 0 or ((filled >= inside.min(0) - 1e-4) & (filled <= inside.max(0) + 1e-4)).all()
    points = np.random.default_rng(0).uniform(tree.bounds_min, tree.bounds_max, (500, 3))
    np.testing.assert_allclose(density_at(full, points), density_at(tree, points), atol=1e-4)


@pytest.mark.parametrize("layout", WRITERS)
def test_trees_of_nothing_have_every_layout(tmp_path: Path, layout: str) -> None:
    empty = tree_from_voxels((2, 3, 1), 0.1, LOW, np.zeros((0, 3), int), np.zeros(0), np.zeros((0, 4, 3)))
    hollow = replace(empty, brick_index=np.where(np.arange(6) == 2, 0, -1).astype(np.int32).reshape(2, 3, 1), voxel_index=np.full((1, 64), -1, np.int32))
    single = tree_from_voxels((1, 1, 1), 0.1, LOW, np.array([[1, 2, 3]]), np.ones(1), np.ones((1, 1, 3)))
    for tree in (empty, hollow, single):
        save(tree, tmp_path / "a.nerftree", layout)
        again = load(tmp_path / "a.nerftree")
        assert (again.degree, again.shape) == (tree.degree, tree.shape)
        assert again.density_values.sum() == tree.density_values.sum()
        describe(tmp_path / "a.nerftree")
