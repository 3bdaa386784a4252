"""Parts of the kernel that renders packed trees against their definitions: harmonics, rows, colours of a view."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from efficientnerf.asset.cascades import voxel_coordinates
from efficientnerf.backends.numba.tree.leaps import octant_leaps
from efficientnerf.backends.numba.tree.packed import packed_of
from efficientnerf.backends.numba.tree.view_colours import packed_pointers, sh_basis
from efficientnerf.backends.numba.vector.maths import popcount
from efficientnerf.rendering.harmonics import basis_numpy
from tests.efficientnerf.trees import random_tree


@pytest.mark.parametrize("degree", range(5))
def test_the_kernels_harmonics_are_those_of_the_project(degree: int) -> None:
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    expected = basis_numpy(directions.astype(np.float64), degree)
    for d, row in zip(directions, expected, strict=True):
        out = np.zeros(len(row), np.float32)
        sh_basis(*d, degree, out)
        np.testing.assert_allclose(out, row, atol=2e-6)


@numba.njit
def pairs(packed, brick):  # type: ignore[no-untyped-def]
    """(B, side, side, side - 1, 2): of each two neighbours along z the first that is stored, and which are: bit 0, bit 1."""
    side, grid = brick + 2, packed_pointers(packed, brick, 0)
    out = np.empty((len(packed.rows), side, side, side - 1, 2), np.int64)
    for row in range(len(packed.rows) * side * side):
        if grid.narrow:
            word = np.int64(grid.rows[row]) & 0xFFFFFFFF
            first, mask = word >> side, word & ((np.int64(1) << side) - 1)
        else:
            first, mask = np.int64(grid.rows[2 * row]), np.int64(grid.rows[2 * row + 1])
        for k in range(side - 1):
            out[row // (side * side), row // side % side, row % side, k] = first + popcount(mask & ((np.int64(1) << k) - 1)), mask >> k & 3
    return out


@pytest.mark.parametrize(("brick", "wide"), [(1, False), (2, True), (4, False), (4, True), (5, False)])
def test_rows_find_the_voxels_of_a_brick_and_of_the_layer_around_it(brick: int, wide: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if wide:
        monkeypatch.setattr("efficientnerf.backends.numba.tree.packed.MOST_BITS", 0)
    tree = random_tree(brick, brick=brick, degree=2, share=0.5)
    packed, side = packed_of(tree), brick + 2
    assert packed.rows.shape == (len(tree.voxel_index), (2 if wide else 1) * side**2)
    count = len(tree.density_values)
    assert np.array_equal(np.sort(packed.voxel_of[:-1]), np.arange(count))
    assert np.array_equal(packed.density[:-1], tree.density_values[packed.voxel_of[:-1]])
    assert packed.density[-1] == 0
    assert np.array_equal(packed.coordinates[:, :count].T, voxel_coordinates(tree)[packed.voxel_of[:-1]])
    assert packed.first_voxel.tolist() == [0, count]
    cells = np.pad(tree.brick_index, 1, constant_values=-1).repeat(brick, 0).repeat(brick, 1).repeat(brick, 2)[brick - 1 :, brick - 1 :, brick - 1 :]
    found = pairs(packed, brick)
    for table, live, place in zip(found, packed.has_density, packed.cells, strict=True):
        at = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1) + place * brick  # of the voxel after the one that is meant
        local = (at - 1) % brick @ [brick**2, brick, 1]
        owner = cells[tuple(at.reshape(-1, 3).T)].reshape(local.shape)
        voxel = np.where(owner >= 0, tree.voxel_index[owner, local], -1)
        low, high = voxel[..., :-1], voxel[..., 1:]
        assert np.array_equal(table[..., 1], (low >= 0) + 2 * (high >= 0))
        first, second = packed.voxel_of[table[..., 0]], packed.voxel_of[np.minimum(table[..., 0] + 1, count)]
        assert np.array_equal(first[low >= 0], low[low >= 0])
        assert np.array_equal(first[(low < 0) & (high >= 0)], high[(low < 0) & (high >= 0)])
        assert np.array_equal(second[(low >= 0) & (high >= 0)], high[(low >= 0) & (high >= 0)])
        density = np.where(voxel >= 0, tree.density_values[voxel], 0)
        eight = np.stack([density[i : i + side - 1, j : j + side - 1, k : k + side - 1] for i, j, k in np.ndindex(2, 2, 2)])
        bits = np.unpackbits(live.view(np.uint8), bitorder="little").astype(bool)
        assert np.array_equal(bits[: side**3].reshape(side, side, side)[:-1, :-1, :-1], (eight > 0).any(axis=0))
        assert bits.sum() == (eight > 0).any(axis=0).sum()


@pytest.mark.parametrize(("shape", "share"), [((7, 5, 6), 0.3), ((1, 9, 2), 0.0), ((270, 1, 1), 0.02)])
def test_leaps_in_eight_directions_are_the_sides_of_empty_cubes(shape: tuple[int, int, int], share: float) -> None:
    occupied = np.random.default_rng(5).random(shape) < share
    leap, at = octant_leaps(occupied), np.argwhere(occupied)
    for octant in range(8):
        signs = np.array([1 if octant >> axis & 1 else -1 for axis in range(3)])
        for cell in np.ndindex(shape):
            ahead = (at - cell) * signs
            ahead = ahead[(ahead >= 0).all(axis=1)]
            assert leap[(octant, *cell)] == min(ahead.max(axis=1).min() if len(ahead) else 255, 255)
