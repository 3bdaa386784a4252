"""benchmarks/captures: whole runs and their table, what is run again, and what becomes of a source that fails."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks import captures as benchmark
from stages.figures.plots import contact_sheet
from tests.stages import captures

TINY = ["--preset", "tiny", "--iterations", "8", "--set", "bake.refine_steps=1", "--set", "evaluate.captured_path_frames=2"]


def test_runs_a_failure_and_what_is_not_run_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, empty, out, runs = captures.nerfstudio(tmp_path / "source"), tmp_path / "empty", tmp_path / "out", tmp_path / "runs"
    empty.mkdir()
    where = ["--out", str(out), "--data", str(tmp_path)]
    one_frame = [*TINY, "--set", "turntable.frames=1"]
    assert benchmark.main([str(source), str(empty), "--runs", str(runs), *where, *one_frame]) == 1
    rows = json.loads((out / "captures.json").read_text())["rows"]
    metrics = json.loads((runs / "source/evaluate/metrics.json").read_text())
    good, bad = rows["source"], rows["empty"]
    assert (good["error"], good["missing"], good["preset"], good["iterations"]) == (None, [], "tiny", 8)
    assert [good[kind]["psnr"] for kind in ("network", "asset", "mesh")] == [metrics[kind]["psnr"] for kind in ("network", "asset", "mesh")]
    assert (good["holes"], good["floaters"]) == (metrics["holes"], metrics["floaters"])
    assert set(good["seconds"]) == set(good["peak_mib"]) == set(benchmark.STAGES)
    assert good["asset_bytes"] == (runs / "source/bake/asset.nerftree").stat().st_size
    assert good["cameras"]["grade"]
    assert benchmark.percent_off(runs / "source", source / "transforms.json") == pytest.approx(0, abs=0.01)
    assert bad["error"].startswith("exit code 2")
    assert bad["asset"]["psnr"] is None
    lines = [line for line in (out / "captures.md").read_text().splitlines() if line.startswith("|")]
    assert len(lines) == 4
    assert {line.count("|") for line in lines} == {len(benchmark.COLUMNS) + 1}
    assert (out / good["picture"]).stat().st_size <= benchmark.MOST_BYTES

    capsys.readouterr()
    shutil.rmtree(source)
    assert benchmark.main([str(source), "--runs", str(runs), *where, *one_frame]) == 0  # its row is of this code and these options
    assert "measured before" in capsys.readouterr().out
    assert json.loads((out / "captures.json").read_text())["rows"] == rows
    assert benchmark.main([str(source), "--runs", str(runs), *where, *TINY, "--set", "turntable.frames=2"]) == 0  # goes on from the poses
    again = json.loads((out / "captures.json").read_text())["rows"]
    assert again["source"]["options"] != good["options"]
    assert again["empty"] == bad

    verdict = {"grade": "poor", "problems": [{"what": "fog"}]}
    (runs / "source/evaluate/verdict.json").write_text(json.dumps(verdict))
    tabulated = tmp_path / "tabulated"
    assert benchmark.main([str(source), "--from", str(runs), "--out", str(tabulated), "--before", str(out / "captures.json")]) == 0
    row = json.loads((tabulated / "captures.json").read_text())["rows"]["source"]
    assert row["asset"] == good["asset"]
    assert row["result"] == {"grade": "poor", "problems": ["fog"]}
    assert "poor (fog)" in (tabulated / "captures.md").read_text()
    again["source"]["asset"]["psnr"] += 0.2
    (out / "captures.json").write_text(json.dumps({"rows": again}))
    assert benchmark.main([str(source), "--from", str(runs), "--out", str(tabulated), "--before", str(out / "captures.json")]) == 1


def test_a_picture_is_photograph_asset_and_mesh_of_the_median_view(tmp_path: Path) -> None:
    colours = [(200, 0, 0), (0, 0, 0), (0, 200, 0), (0, 0, 200)]  # photograph, network, asset, mesh
    (tmp_path / "evaluate").mkdir()
    for name, shift in (("median", 0), ("worst", 40)):
        panels = [np.full((450, 600, 3), np.add(colour, shift), np.uint8) for colour in colours]
        contact_sheet([panels], [["label"] * 4], tmp_path / f"evaluate/strip_{name}.png", thumbnail=600)
    assert benchmark.write_picture(tmp_path, tmp_path / "out/picture.webp")
    with Image.open(tmp_path / "out/picture.webp") as picture:
        assert picture.height == 225
        found = [picture.convert("RGB").getpixel((x, 112)) for x in (150, 454, 758)]
    np.testing.assert_allclose(found, [colours[0], colours[2], colours[3]], atol=6)
    assert not benchmark.write_picture(tmp_path / "out", tmp_path / "out/none.webp")


def test_sets_are_found_by_name(tmp_path: Path) -> None:
    found = benchmark.sources_of(["fern", "snowmiku"], [tmp_path / "mine", tmp_path / "cup/images"], tmp_path)
    assert found == {
        "fern": tmp_path / "fern_4/images_4", "snowmiku": tmp_path / "snowmiku/photos", "mine": tmp_path / "mine", "cup": tmp_path / "cup/images",
    }  # fmt: skip
    assert list(benchmark.sources_of([], [], tmp_path)) == list(benchmark.SETS)
    with pytest.raises(SystemExit, match="nothing: no such set"):
        benchmark.sources_of(["nothing"], [], tmp_path)
