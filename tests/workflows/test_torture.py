"""The short form of `make torture`: real stages, killed a few times, with the same artifacts in the end."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "torture.py"


def load() -> ModuleType:
    spec = importlib.util.spec_from_file_location("torture", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["torture"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_killed_runs_end_in_the_same_artifacts(tmp_path: Path) -> None:
    torture = load()
    work = torture.Torture(tmp_path, torture.source_of(8, tmp_path), torture.OPTIONS, seed=1)
    work.undisturbed()
    work.swap("mesh", "aside")
    work.swap("bake", "placed")
    work.swap("train", "before")
    work.round(["matching", "train", "train", "bake", "mp4", "points"])
    assert work.bad == []
    assert len(work.kills) >= 8
    assert {"poses", "train"} <= {kill.stage for kill in work.kills}
