"""Checkpoints of a refinement whose tree has cascades."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.asset.cascades import subset, voxel_cascades, voxel_coordinates
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


def some_state(tree: NerfTree, pruned: bool) -> RefinementState:
    """Random values, and after the pruning a third of the voxels."""
    rng = np.random.default_rng(2)
    state = initial_state(tree)
    if pruned:
        keep = rng.random(len(state.density)) < 0.3
        state = subset_state(state, keep, subset(state.tree, keep))
    for name in STATE:
        values = getattr(state, name)
        values[:] = rng.integers(1, 100, values.shape)
    state.errors = rng.random((2, 5), np.float32)
    state.step = 7 if pruned else 3
    return state


@pytest.mark.parametrize("pruned", [False, True])
def test_a_checkpoint_gives_the_state_back(pruned: bool, tmp_path: Path) -> None:
    tree = random_cascades(3)
    state = some_state(tree, pruned)
    point = Point(state, SCHEDULE, int(pruned), Pruned(0.25, 0.125, 7) if pruned else None)
    checkpoint.save(job(tmp_path), point)
    found = checkpoint.restored(job(tmp_path), tree, SCHEDULE, cells=5)
    again = found.state
    assert (again.step, found.phase, found.pruned) == (state.step, point.phase, point.pruned)
    for name in STATE:
        np.testing.assert_array_equal(getattr(again, name), getattr(state, name))
    np.testing.assert_array_equal(again.errors, state.errors)
    for name in ("brick_index", "voxel_index", "environment"):
        np.testing.assert_array_equal(getattr(again.tree, name), getattr(state.tree, name))
    for one, other in zip(again.tree.outer, state.tree.outer, strict=True):
        np.testing.assert_array_equal(one.brick_index, other.brick_index)
        np.testing.assert_array_equal(one.bounds_min, other.bounds_min)


CHANGES: dict[str, Callable[[dict[str, np.ndarray]], Any]] = {
    "none": lambda tensors: tensors.pop("cascades"),
    "another cascade": lambda tensors: tensors.update(cascades=(tensors["cascades"] + np.uint8(1)) % np.uint8(3)),
    "no such cascade": lambda tensors: tensors.update(cascades=np.full_like(tensors["cascades"], 3)),
    "wide": lambda tensors: tensors.update(cascades=tensors["cascades"].astype(np.int32)),
    "few": lambda tensors: tensors.update(cascades=tensors["cascades"][:-1]),
    "outside": lambda tensors: tensors.update(coordinates=tensors["coordinates"] + np.int32(50)),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
@pytest.mark.parametrize("pruned", [False, True])
def test_cascades_of_another_tree_are_told(pruned: bool, change: Callable[[dict[str, np.ndarray]], Any]) -> None:
    tree = random_cascades(3)
    state = some_state(tree, pruned)
    about = checkpoint.about_of(Point(state, SCHEDULE, int(pruned), Pruned() if pruned else None))
    tensors = {name: getattr(state, name) for name in STATE}
    tensors |= {"coordinates": voxel_coordinates(state.tree), "cascades": voxel_cascades(state.tree), "about": about}
    assert len(checkpoint.check(tensors, tree, SCHEDULE)[2]) == len(state.density)
    change(tensors)
    with pytest.raises(ValueError, match=r"voxels|cascades"):
        checkpoint.check(tensors, tree, SCHEDULE)
