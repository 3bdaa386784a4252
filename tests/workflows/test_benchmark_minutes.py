"""benchmarks/quality_over_minutes: rows are measured once for each version of the code, and their table goes into a document."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from benchmarks import machine, minutes, quality_over_minutes
from benchmarks.machine import busy_seconds

FIGURES = {
    "psnr": 33.456, "ssim": 0.98765, "views": 200, "stride": 1, "megabytes": 12.34, "peak_mib": 1234.5, "seconds": 61.0, "load": (0.1, 0.1, 0.1), "code": "one",
}  # fmt: skip


def row(name: str = "chair", budget: float = 1, method: str = minutes.OURS, options: str = "", **changes: Any) -> dict[str, Any]:
    return {"method": method, "set": name, "minutes": budget, "options": options, **FIGURES, **changes}


def test_a_row_takes_the_place_of_its_own_kind_alone() -> None:
    rows: list[dict[str, Any]] = []
    for each in (row(budget=5), row(), row(method="nerfacto"), row(options="--seed 1"), row("bench")):
        rows = minutes.with_row(rows, each)
    assert [(r["set"], r["options"], r["minutes"]) for r in rows] == [
        ("bench", "", 1),
        ("chair", "", 1),
        ("chair", "", 5),
        ("chair", "--seed 1", 1),
        ("chair", "", 1),
    ]
    again = minutes.with_row(rows, row(budget=5, psnr=40.0))
    assert [r["psnr"] for r in again] == [33.456, 33.456, 40.0, 33.456, 33.456]
    with pytest.raises(ValueError, match="once"):
        minutes.put_between_marks(f"{minutes.END} {minutes.BEGIN}", "table")


def test_the_table_says_what_differs_between_rows() -> None:
    rows = [row(), row(budget=5, code="two"), row(method="nerfacto", ssim=None, peak_mib=None, stride=8, load=(2.0, 1, 1))]
    lines = minutes.in_markdown(rows).splitlines()
    assert {line.count("|") for line in lines[:5]} == {len(minutes.COLUMNS) + 1}
    assert [cell.strip() for cell in lines[2].split("|")[1:-2]] == ["chair", "efficientnerf", "1", "33.46", "0.9877", "12.3", "1,234", "61"]
    assert all(words in "\n".join(lines[5:]) for words in ("one, two", "chair 1"))
    assert len(minutes.in_markdown([row()]).splitlines()) == 3
    assert "chair 5 (0.9)" in minutes.in_markdown([row(load=(2.0, 1, 1), others=0.02), row(budget=5, others=0.94)])


@pytest.mark.skipif(not machine.STAT.exists(), reason="no /proc/stat")
def test_what_processors_worked_grows_by_what_this_process_works(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begin, own = busy_seconds(), time.process_time()
    while time.process_time() - own < 0.15:
        pass
    end = busy_seconds()
    assert begin is not None
    assert end is not None
    assert end - begin > 0.1
    monkeypatch.setattr(machine, "STAT", tmp_path / "stat")
    for text in ("", "cpu one two", "cpu 1 2 3"):
        assert busy_seconds() is None
        (tmp_path / "stat").write_text(text)


def test_rows_are_measured_once_for_a_version_of_the_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, float, str]] = []

    def measured(name: str, poses: Path, run: Path, budget: float, options: Sequence[str]) -> dict[str, Any]:
        if (name, budget) == ("b", 5) and len(asked) < 4:
            raise KeyboardInterrupt
        asked.append((name, budget, " ".join(options)))
        return {key: value for key, value in row(name, budget, options=" ".join(options)).items() if key != "code"}

    code = "one"
    monkeypatch.setattr(quality_over_minutes, "row_of", measured)
    monkeypatch.setattr(quality_over_minutes, "cameras_of", lambda name, *rest: tmp_path / name)
    monkeypatch.setattr(quality_over_minutes, "code_version", lambda: code)
    readme, out = tmp_path / "README.md", tmp_path / "out"
    readme.write_text(f"before\n{minutes.BEGIN}\nold\n{minutes.END}\nafter\n")
    for name in "ab":
        (tmp_path / "data" / name).mkdir(parents=True)
    call = ["--runs", str(tmp_path / "runs"), "--sets", "a,b", "--minutes", "5,1", "--data", str(tmp_path / "data"), "--out", str(out), "--readme", str(readme)]
    with pytest.raises(KeyboardInterrupt):
        quality_over_minutes.main(call)
    assert asked == [("a", 1, ""), ("b", 1, ""), ("a", 5, "")]
    asked.append(("", 0, ""))
    quality_over_minutes.main(call)
    assert asked[4:] == [("b", 5, "")]
    minutes.write_rows(out / quality_over_minutes.PEERS, [row("a", 1, "nerfacto")])
    quality_over_minutes.main([*call, "--minutes", "1", "--options", "--seed 1"])
    assert asked[5:] == [("a", 1, "--seed 1"), ("b", 1, "--seed 1")]
    text = readme.read_text()
    assert text.startswith(f"before\n{minutes.BEGIN}\n")
    assert text.endswith(f"{minutes.END}\nafter\n")
    assert (text.count("| a |"), text.count("| b |"), text.count("nerfacto")) == (4, 3, 1)
    assert (out / "quality_over_minutes.png").stat().st_size > 1000
    code = "two"
    quality_over_minutes.main([*call, "--minutes", "1"])
    assert asked[7:] == [("a", 1, ""), ("b", 1, "")]
    assert [r["minutes"] for r in json.loads((out / "quality_over_minutes.json").read_text())["rows"]] == [1, 5, 1] * 2
