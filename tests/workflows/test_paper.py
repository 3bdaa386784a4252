"""`enerf paper`: what is written, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pipeline.errors import BadInput, UsageError
from workflows.cli.main import main
from workflows.paper import document as paper
from workflows.paper.document import PAPER, Request, Result, Table


@pytest.fixture
def one_table(monkeypatch: pytest.MonkeyPatch) -> None:
    """A table of two rows in place of the real ones."""

    def measure(request: Request) -> Result:
        rows = [{"method": "ours", "PSNR": 31.456789, "PSNR" + PAPER: 31.68}, {"method": "none", "PSNR": None, "PSNR" + PAPER: None}]
        return Result(["method", "PSNR", "PSNR" + PAPER], rows, ["A note."], {"ours": ([1.0, 2.0], [20.0, 30.0])})

    monkeypatch.setitem(paper.TABLES, "99", Table("A title", False, measure))


def test_a_table_is_written_for_people_and_for_programs(tmp_path: Path, one_table: None) -> None:
    assert main(["paper", "99", "--out", str(tmp_path / "out"), "--scale", "0.5", "--device", "cpu", "--quiet"]) == 0
    text = (tmp_path / "out" / "table_99.md").read_text()
    assert "| ours | 31.46 | 31.68 |" in text
    assert "| none |  |  |" in text
    assert "Scaled by 0.5" in text
    assert "- A note." in text
    document = json.loads((tmp_path / "out" / "table_99.json").read_text())
    assert document["rows"][0]["PSNR"] == 31.456789
    assert document["scale"] == 0.5
    assert document["hardware"]["cores"] >= 1
    assert (tmp_path / "out" / "table_99.png").stat().st_size > 1000


def test_what_is_not_there_is_named(tmp_path: Path, one_table: None, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match="no such table"):
        paper.make("13", Request(None, tmp_path))
    with pytest.raises(BadInput, match="no such folder"):
        paper.make("99", Request(tmp_path / "missing", tmp_path))
    monkeypatch.setitem(paper.TABLES, "98", Table("A title", True, paper.TABLES["99"].measure))
    with pytest.raises(UsageError, match="Give --data DIR"):
        paper.make("98", Request(None, tmp_path))
