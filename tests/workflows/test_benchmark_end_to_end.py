"""benchmarks/end_to_end: a run from photographs to figures, its table, and what becomes of a source that fails."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import end_to_end
from tests.stages import captures

TINY = "--preset tiny --set train.iterations=8 --set bake.refine_steps=1 --set evaluate.captured_path_frames=2 --set turntable.frames=1"


def test_a_table_of_a_run_and_of_one_that_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, empty = captures.nerfstudio(tmp_path / "source"), tmp_path / "empty"
    empty.mkdir()
    made = tmp_path / "figures.json"
    assert end_to_end.main([str(source), str(empty), "--runs", str(tmp_path / "runs"), "--json", str(made), "--options", TINY]) == 1
    good, bad = json.loads(made.read_text())["rows"]
    metrics = json.loads((tmp_path / "runs/source/evaluate/metrics.json").read_text())
    assert good["ok"]
    assert good["gap"]["psnr"] == metrics["gap"]["psnr"]
    assert (good["holes"], good["floaters"]) == (metrics["holes"], metrics["floaters"])
    assert set(good["seconds"]) == {"poses", "train", "bake", "evaluate", "turntable", "mesh", "splats", "points"}
    assert good["asset_bytes"] == (tmp_path / "runs/source/bake/asset.nerftree").stat().st_size
    assert good["frames_per_second"] > 0
    assert not bad["ok"]
    lines = made.with_suffix(".md").read_text().splitlines()
    assert len(lines) == 4
    assert {line.count("|") for line in lines} == {len(end_to_end.COLUMNS) + 1}
    assert f"{metrics['network']['psnr']:.2f} / " in lines[2]
    assert lines[3].startswith("| empty | exit code 2")
    assert lines[2] in capsys.readouterr().out


def test_sets_are_found_by_name(tmp_path: Path) -> None:
    (tmp_path / "snowmiku/photos").mkdir(parents=True)
    found = end_to_end.sources_of(["still_life", "snowmiku"], [tmp_path / "mine"], tmp_path)
    assert found == {"still_life": end_to_end.ROOT / "examples/still_life", "snowmiku": tmp_path / "snowmiku/photos", "mine": tmp_path / "mine"}
    for unknown in ("monstree", "nothing"):
        with pytest.raises(SystemExit, match=f"{unknown}: no such set"):
            end_to_end.sources_of([unknown], [], tmp_path)
