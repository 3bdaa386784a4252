"""A short form of `make faults`, of real stages."""

from pathlib import Path

import pytest

from tests.workflows.torment import torment


@pytest.mark.slow
@pytest.mark.timeout(1800)  # a minute of a core, on a machine that may be very busy
def test_failing_operations_lose_nothing(tmp_path: Path) -> None:
    result = torment(tmp_path, "benchmarks.torture.faults", "--sources", "blender", "--stages", "new,train,mesh", "--share", "25")
    assert result["cases"] >= 8
