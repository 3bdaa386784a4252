"""Table 7 at a small scale: all rows, and what holds on any machine."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from workflows.cli.main import main
from workflows.paper.document import make
from workflows.paper.result import Repetitions, Request
from workflows.paper.table7 import COLUMNS, NAMES, Case

ONCE = Repetitions(cachings=1, queries=1)


def test_table_7_compares_all_structures(tmp_path: Path) -> None:
    make("7", Request(None, tmp_path, 0.12, "cpu", lambda text: None, timings=ONCE))
    table = json.loads((tmp_path / "table_7.json").read_text())
    assert table["columns"] == list(COLUMNS)
    cases = {row["voxels"] for row in table["rows"]}
    assert (len(cases), len(table["rows"])) == (9, 9 * len(NAMES))
    assert all(row[column] > 0 for row in table["rows"] for column in ("memory / MiB", "caching / ms", "random query / ms", "query along rays / ms"))
    assert all(row["memory of dense"] < 0.25 for row in table["rows"] if row["structure"] == "NerfTree")
    paper = [row for row in table["rows"] if row["caching / ms (paper)"] is not None]
    assert {row["voxels"] for row in paper} == {"32³, 20% clustered", "64³, 20% clustered"}
    assert {row["structure"] for row in table["rows"]} - {row["structure"] for row in paper} == {"NerfTree, full bricks as printed"}


def test_the_torch_versions_fill_the_same_table() -> None:
    from workflows.paper import table7 as table

    rows, note = table._measure(Case(32, 0.2), 1000, table._in_torch("cpu"), ONCE)
    assert [row["structure"] for row in rows] == list(NAMES.values())
    kernels, _ = table._measure(Case(32, 0.2), 1000, table._in_numba(), ONCE)
    for row, kernel in zip(rows, kernels, strict=True):
        assert row["memory of dense"] == pytest.approx(kernel["memory of dense"], rel=0.05, abs=0.01), row["structure"]
    assert "6,554 voxels" in note


@pytest.mark.gpu
def test_table_7_on_cuda(tmp_path: Path) -> None:
    import torch

    if not torch.cuda.is_available():
        pytest.skip("no CUDA device that torch can use")
    assert main(["paper", "7", "--out", str(tmp_path), "--scale", "0.06", "--device", "cuda", "--quiet"]) == 0
    table = json.loads((tmp_path / "table_7.json").read_text())
    assert {row["voxels"] for row in table["rows"]} == {"64³, 20% clustered", "64³, 20% scattered"}
