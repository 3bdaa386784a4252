"""`enerf check`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.workflows.command import Enerf
from workflows.asset import STAGES


def noise(folder: Path, count: int) -> Path:
    folder.mkdir()
    for k in range(count):
        Image.fromarray(np.random.default_rng(k).integers(0, 255, (48, 64, 3), np.uint8)).save(folder / f"{k}.png")
    return folder


def test_check_names_problems_and_exits_with_2_where_it_is_hopeless(enerf: Enerf, tmp_path: Path) -> None:
    folder = noise(tmp_path / "photos", 4)
    told = enerf("check", folder, "--json", "--memory", "1m").object
    assert (told["ok"], told["grade"], told["exit_code"]) == (False, "failed", 2)
    assert {"overlap", "few", "tiny", "noise"} <= {problem["what"] for problem in told["problems"]}
    forecast = told["forecast"]
    assert forecast["fits"] is False
    assert list(forecast["stage_seconds"]) == [stage.name for stage in STAGES]
    assert forecast["run_seconds"] == pytest.approx(sum(forecast["stage_seconds"].values()), abs=0.1)
    assert forecast["run_bytes"] > forecast["poses_bytes"]
    assert sorted(told["images"]) == ["0.png", "1.png", "2.png", "3.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photos"]  # nothing is written
    unmeasured = enerf("check", folder, "--set", "train.field=nerf", "--json")
    assert (unmeasured.code, unmeasured.object["forecast"]["run_seconds"]) == (2, None)
    text = enerf("check", folder, "--set", "train.field=nerf")
    assert text.code == 2
    assert all(words in text.err + text.out for words in (str(folder), "failed", "64x48", "--budget"))
