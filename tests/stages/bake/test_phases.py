"""A refinement with several phases: voxels are split and dropped on the way, and it ends in the same bytes wherever it was killed."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.asset import format
from efficientnerf.asset.cascades import voxel_coordinates
from efficientnerf.asset.refinement import fit, schedule, splitting
from efficientnerf.asset.refinement.schedule import Phase, stated_schedule
from efficientnerf.asset.refinement.state import STATE, RefinementState, initial_state
from efficientnerf.asset.tree import NerfTree
from pipeline.stage import Job
from stages.artifacts import BakeOutputs
from stages.bake import pruning
from stages.bake import run as bake
from stages.bake.pruning import Pruned
from stages.bake.refine import checkpoint, refinement
from stages.bake.refine.checkpoint import Point
from stages.bake.settings import BakeSettings
from stages.train import run as train
from tests.efficientnerf.balls import settings
from tests.efficientnerf.trees import random_cascades, random_tree
from tests.stages.balls import job, poses

PHASES = (Phase("coarse", 0.25, "split"), Phase("fine", 0.25, "prune"), Phase("last", 0.5))
QUICK = BakeSettings(resolution=24, samples_per_voxel=1, visibility_rays=1000, refine_rays_per_batch=64, refine_steps=8)
TWELVE = stated_schedule(PHASES, 12)


class Killed(Exception):
    """What a kill leaves behind is what was written before it, as with any error outside of a safe point."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("bake")
    scene = poses(folder / "poses")
    train.run(job(folder / "train", settings(iterations=20, sample_batch_size=2048, occupancy_warmup_steps=10), poses=scene))
    return {"poses": scene, "train": folder / "train" / "out"}


@pytest.fixture(autouse=True)
def split_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schedule, "PHASES", PHASES)
    monkeypatch.setattr("stages.train.log.curve", lambda path, *_, **__: path.write_bytes(b""))


def run(made: Job) -> str:
    bake.run(made)
    return hashlib.sha256((made.out / BakeOutputs.asset).read_bytes() + (made.out / "report.json").read_bytes()).hexdigest()


def at_step(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Die while a step is taken."""
    steps = fit.optimise

    def dying(state: RefinementState, *rest: Any, **more: Any) -> Iterator[float]:
        for error in steps(state, *rest, **more):
            if state.step == number:
                raise Killed
            yield error

    monkeypatch.setattr(fit, "optimise", dying)


def after(module: Any, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Die once a function is done."""
    function = getattr(module, name)

    def dying(*given: Any, **more: Any) -> Any:
        function(*given, **more)
        raise Killed

    monkeypatch.setattr(module, name, dying)


KILLS: dict[str, Callable[[pytest.MonkeyPatch], None]] = {
    "first step": lambda patch: at_step(1, patch),
    "last step before the split": lambda patch: at_step(2, patch),
    "before the split": lambda patch: after(pruning, "prune", patch),
    "in the split": lambda patch: after(splitting, "split", patch),
    "after the split": lambda patch: at_step(3, patch),
    "before the prune": lambda patch: after(pruning, "greatest_weights", patch),
    "after the prune": lambda patch: after(pruning, "prune", patch),
    "in the last phase": lambda patch: at_step(6, patch),
    "at the end": lambda patch: after(refinement, "_publish", patch),
}


def test_killed_in_any_phase_it_ends_in_the_same_bytes(inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(refinement, "CHECKPOINT_SECONDS", -1.0)  # after each step
    whole = job(tmp_path / "whole", QUICK, **inputs)
    digest = run(whole)
    report = json.loads((whole.out / "report.json").read_text())
    tree = format.load(whole.out / BakeOutputs.asset)
    assert tree.resolution == (24, 24, 24)
    assert report["voxels_along_longest_side"] == 24
    assert report["optimisation"]["schedule"] == stated_schedule(PHASES, 8).state()
    resolutions = {line["phase"]: line["resolution"] for line in map(json.loads, (whole.out / BakeOutputs.log).read_text().splitlines())}
    assert resolutions == {"coarse": 12, "fine": 24, "last": 24}
    made = job(tmp_path / "killed", QUICK, **inputs)
    for kill in KILLS.values():  # one after the other: each attempt gets further than the one before
        with monkeypatch.context() as patch:
            kill(patch)
            with pytest.raises(Killed):
                bake.run(made)
    assert run(made) == digest


def test_what_a_split_takes_counts_as_memory(inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    needs = {}
    for count in (0, 1):
        made = job(tmp_path / str(count), replace(QUICK, resolution=12 * 2**count, refine_steps=0), **inputs)
        monkeypatch.setattr(schedule, "PHASES", PHASES[1 - count :] if count else PHASES[1:])
        bake.run(made)
        needs[count] = made.facts["memory"]["terms"]
    assert needs[1]["the grid"] > 3 * needs[0]["the grid"]  # the voxels baked are the same


def some_state(tree: NerfTree, phase: int) -> RefinementState:
    """Random values: of voxels of twice the resolution after the split, of which there are fewer after the pruning."""
    rng = np.random.default_rng(2)
    state = initial_state(tree)
    if phase:
        state = splitting.split(state, rng.random(len(state.density)) < 0.5)
    if phase > 1:
        from efficientnerf.asset.cascades import subset
        from efficientnerf.asset.refinement.state import subset_state

        keep = rng.random(len(state.density)) < 0.3
        state = subset_state(state, keep, subset(state.tree, keep))
    for name in STATE:
        values = getattr(state, name)
        values[:] = rng.integers(1, 100, values.shape)
    state.errors = rng.random((2, 5), np.float32)
    state.step = (2, 4, 12)[phase]
    return state


TREES: dict[str, Callable[[], NerfTree]] = {
    "one grid": lambda: random_tree(3), "nearest": lambda: random_tree(4, lookup="nearest"), "cascades": lambda: random_cascades(3),
}  # fmt: skip


@pytest.mark.parametrize("phase", [0, 1, 2])
@pytest.mark.parametrize("tree", TREES.values(), ids=TREES)
def test_a_checkpoint_gives_the_state_of_any_phase_back(tree: Callable[[], NerfTree], phase: int, tmp_path: Path) -> None:
    made, baked = job(tmp_path, None), tree()
    point = Point(some_state(baked, phase), TWELVE, phase, Pruned(0.5, 0.25, 3) if phase else None, 20.0, 10.0)
    checkpoint.save(made, point)
    found = checkpoint.restored(made, baked, TWELVE, cells=5)
    assert (found.state.step, found.phase, found.pruned, found.seconds, found.began) == (point.state.step, phase, point.pruned, 20.0, 10.0)
    for name in STATE:
        np.testing.assert_array_equal(getattr(found.state, name), getattr(point.state, name))
    for name in ("shape", "voxel", "brick", "lookup", "background"):
        assert getattr(found.state.tree, name) == getattr(point.state.tree, name)
    for name in ("brick_index", "voxel_index", "bounds_min"):
        np.testing.assert_array_equal(getattr(found.state.tree, name), getattr(point.state.tree, name))
    for one, other in zip(found.state.tree.outer, point.state.tree.outer, strict=True):
        np.testing.assert_array_equal(one.brick_index, other.brick_index)
        assert (one.shape, one.voxel) == (other.shape, other.voxel)
    in_baked = checkpoint.ancestors(baked, found.state.tree, min(phase, 1))
    np.testing.assert_array_equal(voxel_coordinates(baked)[in_baked], voxel_coordinates(found.state.tree) >> min(phase, 1))


CHANGES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "backwards": lambda at: at[::-1], "twice": lambda at: np.concatenate([at[:1], at[:-1]]), "elsewhere": lambda at: at + np.int32(2),
    "below": lambda at: at - np.int32(2), "swapped": lambda at: np.concatenate([at[1:2], at[:1], at[2:]]), "not split": lambda at: at >> 1,
}  # fmt: skip


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
@pytest.mark.parametrize("tree", TREES.values(), ids=TREES)
def test_voxels_of_another_split_are_told(tree: Callable[[], NerfTree], change: Callable[[np.ndarray], np.ndarray], tmp_path: Path) -> None:
    from safetensors.numpy import load_file, save_file

    events: list[dict[str, Any]] = []
    made, baked = job(tmp_path, None, events=events), tree()
    checkpoint.save(made, Point(some_state(baked, 2), TWELVE, 2, Pruned()))
    path = made.work / checkpoint.CHECKPOINT
    tensors = load_file(path)
    tensors["coordinates"] = np.ascontiguousarray(change(tensors["coordinates"]))
    save_file(tensors, path, metadata={"sha256": checkpoint.digest_of(tensors)})
    assert checkpoint.restored(made, baked, TWELVE, cells=5) is None
    assert [event["event"] for event in events] == ["warning"]
    assert not path.exists()
