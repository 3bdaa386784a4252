"""Checkpoints of a refinement whose tree has cascades."""

from pathlib import Path

import numpy as np
import pytest

from efficientnerf.asset.cascades import subset
from efficientnerf.asset.refinement.schedule import stated_schedule
from efficientnerf.asset.refinement.state import STATE, RefinementState, initial_state, subset_state
from efficientnerf.asset.tree import NerfTree
from pipeline.stage import Job
from stages.bake.pruning import Pruned
from stages.bake.refine import checkpoint
from stages.bake.refine.checkpoint import Point
from tests.efficientnerf.trees import random_cascades

SCHEDULE = stated_schedule(12)


def job(folder: Path) -> Job:
    return Job(settings=None, out=folder / "out", work=folder)


def some_state(tree: NerfTree, kept: np.ndarray | None) -> RefinementState:
    """Random values of some voxels, or all."""
    rng = np.random.default_rng(2)
    state = initial_state(tree)
    if kept is not None:
        state = subset_state(state, kept, subset(state.tree, kept))
    for name in STATE:
        values = getattr(state, name)
        values[:] = rng.integers(1, 100, values.shape)
    state.errors = rng.random((2, 5), np.float32)
    state.step = 3 if kept is None else 7
    return state


@pytest.mark.parametrize("pruned", [False, True])
def test_a_checkpoint_gives_the_state_back(pruned: bool, tmp_path: Path) -> None:
    tree = random_cascades(3)
    kept = np.random.default_rng(1).random(len(tree.density_values)) < 0.3 if pruned else None
    state = some_state(tree, kept)
    point = Point(state, SCHEDULE, int(pruned), Pruned(0.25, 0.125, 7) if pruned else None, kept)
    checkpoint.save(job(tmp_path), point)
    found = checkpoint.restored(job(tmp_path), tree, SCHEDULE, cells=5)
    again = found.state
    assert (again.step, found.phase, found.pruned) == (state.step, point.phase, point.pruned)
    for name in STATE:
        np.testing.assert_array_equal(getattr(again, name), getattr(state, name))
    np.testing.assert_array_equal(again.errors, state.errors)
    np.testing.assert_array_equal(found.kept, kept)
    for name in ("brick_index", "voxel_index", "environment"):
        np.testing.assert_array_equal(getattr(again.tree, name), getattr(state.tree, name))
    for one, other in zip(again.tree.outer, state.tree.outer, strict=True):
        np.testing.assert_array_equal(one.brick_index, other.brick_index)
        np.testing.assert_array_equal(one.bounds_min, other.bounds_min)
