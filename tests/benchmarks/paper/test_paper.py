"""`python -m benchmarks.paper`: what is written, and what is refused."""

import json
from pathlib import Path

import pytest

from benchmarks.paper.__main__ import main
from benchmarks.paper.document import make
from benchmarks.paper.result import PAPER, Request, Result, Table
from pipeline.errors import BadInput, UsageError


def measure(request: Request) -> Result:
    rows = [{"method": "ours", "PSNR": 31.456789, "PSNR" + PAPER: 31.68}, {"method": "none", "PSNR": None, "PSNR" + PAPER: None}]
    return Result(["method", "PSNR", "PSNR" + PAPER], rows, ["A note."], {"ours": ([1.0, 2.0], [20.0, 30.0])})


SOME = {"98": Table("A title", True, measure), "99": Table("A title", False, measure)}


def test_a_table_is_written_for_people_and_for_programs(tmp_path: Path) -> None:
    make("99", Request(None, tmp_path / "out", 0.5), SOME)
    text = (tmp_path / "out" / "table_99.md").read_text()
    assert all(each in text for each in ("| ours | 31.46 | 31.68 |", "| none |  |  |", "0.5", "A note."))
    document = json.loads((tmp_path / "out" / "table_99.json").read_text())
    assert (document["rows"][0]["PSNR"], document["scale"]) == (31.456789, 0.5)
    assert document["hardware"]["cores"] >= 1
    assert (tmp_path / "out" / "table_99.png").stat().st_size > 1000


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="13"):
        make("13", Request(None, tmp_path), SOME)
    with pytest.raises(BadInput, match="missing"):
        make("99", Request(tmp_path / "missing", tmp_path), SOME)
    with pytest.raises(UsageError, match="--data DIR"):
        make("98", Request(None, tmp_path), SOME)
    assert main(["13", "--out", str(tmp_path), "--quiet"]) == 2
