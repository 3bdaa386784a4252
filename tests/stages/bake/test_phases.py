"""A refinement ends in the same bytes wherever it was killed."""

import hashlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from efficientnerf.asset.refinement import fit
from efficientnerf.asset.refinement.schedule import stated_schedule
from efficientnerf.asset.refinement.state import RefinementState
from pipeline.stage import Job
from stages.artifacts import BakeOutputs
from stages.bake import pruning
from stages.bake import run as bake
from stages.bake.refine import refinement
from stages.bake.settings import BakeSettings
from stages.train.previews import Previews
from tests.stages.balls import job

QUICK = BakeSettings(resolution=24, samples_per_voxel=1, visibility_rays=1000, refine_rays_per_batch=64, refine_steps=8)


class Killed(Exception):
    """What a kill leaves behind is what was written before it, as with any error outside of a safe point."""


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
    "last step before voxels are dropped": lambda patch: at_step(2, patch),
    "before voxels are dropped": lambda patch: after(pruning, "greatest_weights", patch),
    "once voxels are dropped": lambda patch: after(pruning, "prune", patch),
    "first step after that": lambda patch: at_step(3, patch),
    "in the second phase": lambda patch: at_step(6, patch),
    "at the end": lambda patch: after(Previews, "publish", patch),
}


def test_killed_in_any_phase_it_ends_in_the_same_bytes(inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(refinement, "CHECKPOINT_SECONDS", -1.0)  # after each step
    whole = job(tmp_path / "whole", QUICK, **inputs)
    digest = run(whole)
    report = json.loads((whole.out / "report.json").read_text())
    assert report["optimisation"]["schedule"] == stated_schedule(8).state()
    made = job(tmp_path / "killed", QUICK, **inputs)
    for kill in KILLS.values():  # one after the other: each attempt gets further than the one before
        with monkeypatch.context() as patch:
            kill(patch)
            with pytest.raises(Killed):
                bake.run(made)
    assert run(made) == digest
