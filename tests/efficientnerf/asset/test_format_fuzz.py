"""The short form of benchmarks/fuzz_format.py, and what its long form found."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

SCRIPT = Path(__file__).resolve().parents[3] / "benchmarks" / "fuzz_format.py"


def fuzz() -> ModuleType:
    spec = importlib.util.spec_from_file_location("fuzz_format", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_files_changed_at_random_are_read_or_refused(tmp_path: Path) -> None:
    found: list[dict[str, Any]] = []
    fuzz().batch(1, 0, 1500, tmp_path, found.append)
    assert found[0]["failures"] == []
    assert found[0]["inputs"] == 1500
    assert set(found[0]["kinds"]) == {"bytes", "header bytes", "json", "tensor"}
    assert found[0]["read"] > 50  # not all end at the first check
    assert len(found[0]["refusals"]) > 80


def test_equal_seeds_give_equal_files() -> None:
    module = fuzz()
    seeds = [path.read_bytes() for path in sorted(module.GOLDEN.glob("*.nerftree"))]
    rngs = [np.random.Generator(np.random.Philox(key=3)) for _ in range(2)]
    assert [module.changed(rngs[0], seeds) for _ in range(50)] == [module.changed(rngs[1], seeds) for _ in range(50)]


def test_the_long_run_found_nothing() -> None:
    result = json.loads((SCRIPT.parent / "results" / "fuzz_format.json").read_text())
    assert result["inputs"] >= 100_000
    assert result["failures"] == []
    assert result["peak_rss_mib"] - result["rss_before_mib"] < 1024
