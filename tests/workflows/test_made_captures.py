"""benchmarks/scenes/captures and benchmarks/made_captures: captures that no rule was made on, and that nothing of their subjects is masked before training."""

from pathlib import Path

import pytest

from benchmarks import made_captures
from benchmarks.scenes import captures

WIDTH = 120
KINDS = captures.captures()


@pytest.mark.parametrize("kind", [*KINDS][::4])
def test_no_subject_is_masked_before_training(kind: str, tmp_path: Path) -> None:
    row = made_captures.measured(kind, KINDS[kind], tmp_path, WIDTH, 48, seed=0)
    assert row["masked"] <= made_captures.MOST_MASKED
    assert 0 < row["near"][2] < row["distance"]  # no near plane behind the subject
    assert row["size"] > 0.15  # of the box, which is 2: it is not lost in a landscape
