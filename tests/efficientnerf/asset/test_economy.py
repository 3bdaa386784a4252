"""Codes chosen for what they cost: smaller files, errors where they show least, the same codes every time."""

from dataclasses import replace

import numpy as np

from efficientnerf.asset.economy import DEFAULT_RATE, economy_of
from efficientnerf.asset.format import serialize
from efficientnerf.asset.quantisation import compacted
from efficientnerf.asset.tree import NerfTree, tree_from_voxels
from tests.efficientnerf.trees import LOW


def ball(size: int = 20, noise: float = 0.05) -> NerfTree:
    """A ball's surface: values that vary smoothly, and noise as a fit leaves it."""
    rng = np.random.default_rng(0)
    centre = np.mgrid[:size, :size, :size].reshape(3, -1).T - size / 2
    at = (centre[np.abs(np.linalg.norm(centre, axis=1) - size / 3) < 1.5] + size / 2).astype(int)
    sh = np.sin(at @ rng.normal(size=(3, 12)) * 0.15).reshape(len(at), 4, 3) + noise * rng.normal(size=(len(at), 4, 3))
    sh[:, 1:] *= 0.5
    return tree_from_voxels((size // 4,) * 3, 0.05, LOW, at, rng.uniform(1, 60, len(at)), sh.astype(np.float32), background=(1.0, 1.0, 1.0))


def error(tree: NerfTree, coded: NerfTree, weight: np.ndarray) -> float:
    return float((weight[:, None, None] * (tree.sh - coded.sh) ** 2).mean())


def test_a_greater_rate_takes_fewer_bytes_and_errs_more() -> None:
    tree = ball()
    weight = -np.expm1(-tree.density_values * tree.voxel)
    coded = [economy_of(tree, weight, 64).at(DEFAULT_RATE * factor) for factor in (0.01, 1, 30)]
    sizes = [len(serialize(one, "packed")) for one in coded]
    errors = [error(tree, one, weight) for one in coded]
    assert sizes[0] > sizes[1] > sizes[2]
    assert errors[0] < errors[1] < errors[2]
    assert sizes[1] < len(serialize(compacted(tree, 64), "packed")), sizes


def test_voxels_that_weigh_more_err_less() -> None:
    tree = ball()
    rng = np.random.default_rng(1)
    heavy = rng.random(len(tree.density_values)) < 0.5
    coded = economy_of(tree, np.where(heavy, 1.0, 1e-3).astype(np.float32), 64).at(3e-5)
    wrong = ((tree.sh - coded.sh) ** 2).mean(axis=(1, 2))
    assert wrong[heavy].mean() < 0.5 * wrong[~heavy].mean()
    opacity, seen = (-np.expm1(-one.density_values * tree.voxel) for one in (tree, coded))
    assert np.abs(opacity - seen)[heavy].mean() < np.abs(opacity - seen)[~heavy].mean()


def test_codes_do_not_depend_on_the_order_of_voxels() -> None:
    tree = ball()
    rng = np.random.default_rng(2)
    order = rng.permutation(len(tree.density_values))
    back = np.argsort(order)
    other = replace(
        tree,
        voxel_index=np.where(tree.voxel_index >= 0, back[tree.voxel_index], -1).astype(np.int32),
        density_values=tree.density_values[order],
        harmonics=tree.sh[order],
    )
    data = serialize(economy_of(tree, entries=32).at(DEFAULT_RATE), "packed")
    assert serialize(economy_of(tree, entries=32).at(DEFAULT_RATE), "packed") == data
    assert serialize(economy_of(other, entries=32).at(DEFAULT_RATE), "packed") == data
