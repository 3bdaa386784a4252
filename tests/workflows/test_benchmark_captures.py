"""benchmarks/captures: whole runs and their table, what is run again, and what becomes of a source that fails."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from benchmarks import captures as benchmark
from tests.stages import captures

TINY = ["--preset", "tiny", "--iterations", "8", "--set", "bake.refine_steps=1", "--set", "evaluate.captured_path_frames=2", "--set", "turntable.frames=1"]


def rows_of(out: Path) -> dict[str, Any]:
    rows: dict[str, Any] = json.loads((out / "captures.json").read_text())["rows"]
    return rows


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run of a source, whose table is in out/."""
    folder = tmp_path_factory.mktemp("captures")
    captures.nerfstudio(folder / "source")
    assert benchmark.main([str(folder / "source"), "--runs", str(folder / "runs"), "--out", str(folder / "out"), "--data", str(folder), *TINY]) == 0
    return folder


def test_a_row_is_what_the_run_says(made: Path) -> None:
    row, run = rows_of(made / "out")["source"], made / "runs/source"
    metrics = json.loads((run / "evaluate/metrics.json").read_text())
    assert (row["error"], row["missing"], row["preset"], row["iterations"]) == (None, [], "tiny", 8)
    assert [row[kind]["psnr"] for kind in ("network", "asset", "mesh")] == [metrics[kind]["psnr"] for kind in ("network", "asset", "mesh")]
    assert set(row["seconds"]) == set(row["peak_mib"]) == set(benchmark.STAGES)
    assert row["asset_bytes"] == (run / "bake/asset.nerftree").stat().st_size
    for grade, stage in ((row["cameras"]["grade"], "poses"), (row["result"]["grade"], "evaluate")):
        assert grade == json.loads((run / stage / "verdict.json").read_text())["grade"]
    assert benchmark.percent_off(run, made / "source/transforms.json") == pytest.approx(0, abs=0.01)
    assert (made / "out" / row["picture"]).stat().st_size <= benchmark.MOST_BYTES


def test_a_source_that_fails_has_a_row_and_the_others_stay(made: Path, tmp_path: Path) -> None:
    shutil.copytree(made / "out", tmp_path / "out")
    (tmp_path / "empty").mkdir()
    assert benchmark.main([str(tmp_path / "empty"), "--runs", str(tmp_path / "runs"), "--out", str(tmp_path / "out"), *TINY]) == 1
    rows = rows_of(tmp_path / "out")
    assert rows["source"] == rows_of(made / "out")["source"]
    assert (rows["empty"]["error"].startswith("exit code 2"), rows["empty"]["asset"]["psnr"]) == (True, None)
    lines = [line for line in (tmp_path / "out/captures.md").read_text().splitlines() if line.startswith("|")]
    assert [line.count("|") for line in lines] == [len(benchmark.COLUMNS) + 1] * 4


def test_what_is_measured_before_is_not_run_again(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[tuple[str, ...]] = []
    monkeypatch.setattr(benchmark, "run_capture", lambda source, run, options: ran.append(tuple(options)))
    where = [str(made / "source"), "--runs", str(made / "runs"), "--data", str(made)]
    shutil.copytree(made / "out", made / "again")
    assert benchmark.main([*where, "--out", str(made / "again"), *TINY]) == 0
    assert not ran
    assert benchmark.main([*where, "--out", str(made / "again"), *TINY, "--set", "turntable.frames=2"]) == 0
    assert [options[-1] for options in ran] == ["turntable.frames=2"]
    assert rows_of(made / "again")["source"]["options"] != rows_of(made / "out")["source"]["options"]
