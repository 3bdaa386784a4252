"""The short form of benchmarks/fuzz_format.py, and what its long form found."""

from __future__ import annotations

import importlib.util
import json
import signal
import sys
from pathlib import Path
from types import ModuleType

SCRIPT = Path(__file__).resolve().parents[3] / "benchmarks" / "fuzz_format.py"


def fuzz() -> ModuleType:
    spec = importlib.util.spec_from_file_location("fuzz_format", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(SCRIPT.parent))
    try:
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(SCRIPT.parent))
    return module


def test_files_changed_at_random_are_read_or_refused(tmp_path: Path) -> None:
    before = signal.getsignal(signal.SIGPROF)
    try:
        module = fuzz()
        module.warm_up()
        found = module.batch(1, 0, 250, tmp_path, None)
    finally:
        signal.signal(signal.SIGPROF, before)
    assert found["failures"] == []
    assert found["inputs"] == 250
    assert set(found["kinds"]) == {"bytes", "header bytes", "json", "tensor", "values", "numbers", "built"}
    assert sum(found["read"].values()) > 50  # not all end at the first check
    assert len(found["refusals"]) > 40


def test_the_long_run_found_nothing() -> None:
    result = json.loads((SCRIPT.parent / "results" / "fuzz_format.json").read_text())
    assert result["inputs"] >= 100_000
    assert result["failures"] == []
    assert result["peak_rss_mib"] - result["rss_before_mib"] < 1024
