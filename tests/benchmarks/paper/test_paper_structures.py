"""Table 7 at a small scale: all rows, and what holds on any machine."""

import json
from pathlib import Path

import pytest

from benchmarks.paper import table7
from benchmarks.paper.__main__ import main


def test_table_7_compares_all_structures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table7, "CACHINGS", 1)
    monkeypatch.setattr(table7, "QUERIES", 1)
    assert main(["7", "--out", str(tmp_path), "--scale", "0.12", "--device", "cpu", "--quiet"]) == 0
    table = json.loads((tmp_path / "table_7.json").read_text())
    assert table["columns"] == list(table7.COLUMNS)
    cases = {row["voxels"] for row in table["rows"]}
    assert (len(cases), len(table["rows"])) == (8, 8 * len(table7.KINDS))
    assert all(row[column] > 0 for row in table["rows"] for column in ("memory / MiB", "caching / ms", "random query / ms", "query along rays / ms"))
    assert all(row["memory of dense"] < 0.25 for row in table["rows"] if row["structure"] == "NerfTree")
    assert any("6,554 voxels" in note for note in table["notes"])
    paper = [row for row in table["rows"] if row["caching / ms (paper)"] is not None]
    assert {row["voxels"] for row in paper} == {"32³, 20% clustered", "64³, 20% clustered"}
    assert {row["structure"] for row in table["rows"]} - {row["structure"] for row in paper} == {"NerfTree, full bricks as printed"}


@pytest.mark.gpu
def test_table_7_on_cuda(tmp_path: Path) -> None:
    import torch

    if not torch.cuda.is_available():
        pytest.skip("no CUDA device that torch can use")
    assert main(["7", "--out", str(tmp_path), "--scale", "0.06", "--device", "cuda", "--quiet"]) == 0
    table = json.loads((tmp_path / "table_7.json").read_text())
    assert {row["voxels"] for row in table["rows"]} == {"64³, 20% clustered", "64³, 20% scattered"}
