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
    assert [(r["set"], r["method"], r["options"], r["minutes"]) for r in rows] == [
        ("bench", minutes.OURS, "", 1), ("chair", minutes.OURS, "", 1), ("chair", minutes.OURS, "", 5), ("chair", minutes.OURS, "--seed 1", 1),
        ("chair", "nerfacto", "", 1),
    ]  # fmt: skip
    again = minutes.with_row(rows, row(budget=5, psnr=40.0))
    assert [r["psnr"] for r in again] == [33.456, 33.456, 40.0, 33.456, 33.456]
    assert len(rows) == 5


def test_every_source_counts_as_a_version_and_nothing_else(tmp_path: Path) -> None:
    for package in minutes.PACKAGES:
        (tmp_path / package / "__pycache__").mkdir(parents=True)
        (tmp_path / package / "a.py").write_text("1")
    seen = {minutes.code_version(tmp_path)}
    (tmp_path / "stages/__pycache__/a.py").write_text("1")
    (tmp_path / "stages/notes.md").write_text("1")
    assert minutes.code_version(tmp_path) in seen
    for change in (
        lambda: (tmp_path / "stages/a.py").write_text("2"),
        lambda: (tmp_path / "workflows/b.toml").touch(),
        lambda: (tmp_path / "stages/a.py").rename(tmp_path / "stages/b.py"),
    ):
        change()
        assert minutes.code_version(tmp_path) not in seen
        seen.add(minutes.code_version(tmp_path))


@pytest.mark.skipif(not machine.STAT.exists(), reason="no /proc/stat")
def test_what_processors_worked_grows_by_what_this_process_works() -> None:
    begin, own = busy_seconds(), time.process_time()
    assert begin is not None
    while time.process_time() - own < 0.3:
        pass
    end = busy_seconds()
    assert end is not None
    assert end - begin > 0.2


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
    table = minutes.in_markdown(
        [r for name in "ab" for r in (row(name), row(name, 5), row(name, options="--seed 1"), *([row(name, method="nerfacto")] if name == "a" else []))]
    )
    assert readme.read_text() == f"before\n{minutes.BEGIN}\n\n{table}\n{minutes.END}\nafter\n"
    assert (out / "quality_over_minutes.md").read_text().endswith(table)
    assert (out / "quality_over_minutes.png").stat().st_size > 1000
    code = "two"
    quality_over_minutes.main([*call, "--minutes", "1"])
    assert asked[7:] == [("a", 1, ""), ("b", 1, "")]
    assert [r["minutes"] for r in json.loads((out / "quality_over_minutes.json").read_text())["rows"]] == [1, 5, 1] * 2
