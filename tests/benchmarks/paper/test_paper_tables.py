"""Tables that train: what a scale makes of the settings, what a log says of the pace, what the tables make of figures, and one table from end to end."""

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks.paper import document as paper
from benchmarks.paper import pretrained, tables
from benchmarks.paper.__main__ import main
from benchmarks.paper.pretrained import Finetuned
from benchmarks.paper.result import PAPER, Request
from benchmarks.paper.runs import Figures, Row, _pace, settings_of
from tests.benchmarks.paper.scenes import ball


def test_scale_one_is_the_paper_and_less_shrinks_everything_together() -> None:
    whole, small = (settings_of(Row("n4"), scale) for scale in (1.0, 0.001))
    assert (whole["train"]["iterations"], whole["train"]["hidden_dim"], whole["poses"]["max_image_size"]) == (1_000_000, 256, 800)
    smaller = ("iterations", "max_rays_per_batch", "hidden_dim", "coarse_hidden_dim", "num_layers", "occupancy_resolution")
    assert all(small["train"][name] < whole["train"][name] for name in smaller)
    assert small["poses"]["max_image_size"] < 800
    assert small["bake"]["resolution"] < whole["bake"]["resolution"]
    kept = ("num_coarse_samples", "samples_per_pivot", "near_plane", "far_plane", "sh_degree", "pivotal_threshold", "occupancy_beta", "sampling", "max_pivots")
    assert all(small["train"][name] == whole["train"][name] for name in kept)
    light, standard = small["train"], settings_of(Row("nerf", tables.NERF), 0.001)["train"]
    assert light["coarse_hidden_dim"] < standard["coarse_hidden_dim"] == standard["hidden_dim"]
    differ = {name for name in light if light[name] != standard[name]}
    assert differ == {"field", "sampling", "num_coarse_samples", "coarse_hidden_dim", "coarse_num_layers"}  # so the rest is shared


def test_the_pace_is_that_of_the_log() -> None:
    lines = [
        {"step": step, "step_seconds": 2.0 if step <= 50 else 1.0, "preview_psnr": None if step % 50 else 20.0 + step, "rays": 10, "valid": 30, "fine": 50}
        for step in range(10, 101, 10)
    ]
    pace = _pace(lines)
    assert pace["step"] == pytest.approx(1.5)
    assert pace["steady"] == 1.0
    assert pace["hours"] == pytest.approx(150 / 3600)
    assert (pace["coarse"], pace["fine"]) == (3.0, 5.0)
    assert pace["curve"] == ([100.0, 150.0], [70.0, 120.0])


def made_up(steady: float, psnr: float) -> Figures:
    tree = {"psnr": psnr - 0.5, "ssim": 0.9, "fps": 20.0, "frame": "100x100"}
    return Figures(psnr, 0.95, 2 * steady, steady, 1.0, 12.0, 24.0, 0.1, 0.04, ([1.0, 2.0], [20.0, psnr]), tree)


@pytest.mark.parametrize("number", ["1", "2", "3", "4", "5", "6"])
def test_every_table_can_be_made_of_figures(number: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def measured(request: Request, scene: Path, row: Row) -> Figures:
        settings_of(row, request.scale)  # its settings exist
        return made_up(0.184 if row.name == "nerf" else 0.021, 21.0 if row.name == "valid" else 30.0)

    def finetuned(request: Request, data: Path, method: str, sampling: str, settings: dict[str, dict[str, Any]], seed: int) -> Finetuned:
        return Finetuned(0.1, 1.0, 10.0, 20.0, [1.0, 2.0, 3.0], [15.0, 20.0, 25.0 if sampling == "uniform" else 24.0])

    monkeypatch.setattr(tables, "measured", measured)
    monkeypatch.setattr(pretrained, "finetuned", finetuned)
    monkeypatch.setattr(pretrained, "weights_of", lambda method: tmp_path)
    ball(tmp_path / "scenes" / "chair")
    paper.make(number, Request(tmp_path / "scenes", tmp_path / "out", 0.001))
    document = json.loads((tmp_path / "out" / f"table_{number}.json").read_text())
    assert any(column.endswith(PAPER) for column in document["columns"])
    assert all(set(row) <= set(document["columns"]) for row in document["rows"])
    assert (tmp_path / "out" / f"table_{number}.png").exists()
    if number == "6":
        assert [row["method"] for row in document["rows"]] == ["NeRF"] * 3 + ["IBRNet"] * 2 + ["MVSNeRF"] * 2 + ["PlenOctree"] * 2
        assert [row.get(pretrained.EQUAL) for row in document["rows"][3:5]] == [2.8, 3.0]
    if number == "5":
        assert document["rows"][0]["method"] == "NeRF"
        for column in ("less time %", "less time %" + PAPER):
            assert document["rows"][-1][column] == pytest.approx(88.6, abs=0.1)
        assert "valid on chair" in " ".join(document["notes"]), "what has not converged does not count"
    if number == "1":
        assert document["rows"][0]["valid %" + PAPER] == 9.58


def test_a_table_from_end_to_end_goes_on_with_its_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, out = ball(tmp_path / "ball"), tmp_path / "out"
    command = ["1", "--data", str(data), "--out", str(out), "--scale", "0.00001", "--device", "cpu", "--json"]
    assert main(command) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert events[-1]["event"] == "summary"
    assert sum(event["event"] == "stage_done" and event["stage"] == "train" for event in events) == 2
    assert any(event["event"] == "progress" and event["stage"] == "train" for event in events)  # hours go by without a word otherwise
    nerf, ours = json.loads((out / "table_1.json").read_text())["rows"]
    assert 0 < ours["pivotal %"] <= ours["valid %"] < 100
    assert 0 < nerf["pivotal %"] < 100
    assert min(nerf["PSNR"], ours["PSNR"]) > 10
    field = out / "runs/ball/n4/train/field.safetensors"
    made = field.stat().st_mtime_ns
    assert main(command) == 0
    assert field.stat().st_mtime_ns == made
    (tmp_path / "none").mkdir()
    assert main([*command, "--data", str(tmp_path / "none")]) == 2
