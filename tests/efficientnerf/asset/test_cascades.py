"""Nested grids: how they nest, which voxels belong to which, and the reference render of them."""

from dataclasses import replace

import numpy as np
import pytest

from efficientnerf.asset.cascades import (
    brick_ranges,
    cascade_grids,
    cascade_tree,
    cascades_of,
    check_cascades,
    nested,
    voxel_cascades,
    voxel_coordinates,
    voxel_sides,
)
from tests.efficientnerf.trees import random_cascades, uniform_tree


@pytest.mark.parametrize("count", [1, 2, 5])
def test_grids_nest_and_cover_the_bounds(count: int) -> None:
    bounds = np.array([[-1.0, -0.7, -0.2], [1.0, 0.4, 0.3]])
    grids = cascade_grids(bounds, 0.013, 4, count)
    assert len(grids) == count
    shape, voxel, low = grids[0]
    assert (low <= bounds[0] + 1e-9).all()
    assert (low + np.array(shape) * 4 * voxel >= bounds[1] - 1e-9).all()
    trees = [replace(uniform_tree((1, 1, 1)), shape=s, voxel=v, bounds_min=b, brick_index=np.full(s, -1, np.int32),
                     voxel_index=np.zeros((0, 64), np.int32), density_values=np.zeros(0, np.float32), harmonics=np.zeros((0, 1, 3), np.float32))
             for s, v, b in grids]  # fmt: skip
    check_cascades(nested(trees))


def test_cascades_come_apart_again() -> None:
    tree = random_cascades(3)
    assert len(cascades_of(tree)) == 3
    ranges, cascade_of = brick_ranges(tree), voxel_cascades(tree)
    assert ranges[0][0] == 0
    assert ranges[-1][1] == len(tree.voxel_index)
    parts = [cascade_tree(tree, n) for n in range(3)]
    np.testing.assert_array_equal(np.concatenate([part.density_values for part in parts]), tree.density_values)
    np.testing.assert_array_equal(np.concatenate([voxel_coordinates(part) for part in parts]), voxel_coordinates(tree))
    np.testing.assert_allclose(voxel_sides(tree), tree.voxel * 2.0**cascade_of, rtol=1e-6)
    again = nested(parts, tree.environment)
    np.testing.assert_array_equal(again.voxel_index, tree.voxel_index)
    for one, other in zip(again.outer, tree.outer, strict=True):
        np.testing.assert_array_equal(one.brick_index, other.brick_index)


@pytest.mark.parametrize("wrong", ["voxel", "shifted", "smaller"])
def test_cascades_that_do_not_nest_are_refused(wrong: str) -> None:
    tree = random_cascades(6)
    first = tree.outer[0]
    changed = {
        "voxel": replace(first, voxel=first.voxel * 1.01),
        "shifted": replace(first, bounds_min=first.bounds_min + 0.5 * first.voxel),
        "smaller": replace(first, bounds_min=tree.bounds_min + 2 * tree.brick * first.voxel),
    }[wrong]
    with pytest.raises(ValueError, match="cascade"):
        check_cascades(replace(tree, outer=(changed, *tree.outer[1:])))
