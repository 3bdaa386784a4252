"""The page about a run: it says what is there, points only to files that are, and is not led astray by what names hold."""

import json
import os
from concurrent.futures import ThreadPoolExecutor
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest

from pipeline.run import Run
from tests.workflows.command import Enerf
from tests.workflows.toys import TOYS
from workflows.report import page as page_module
from workflows.report.page import page, write_report


class Links(HTMLParser):
    """Every href, src and poster; and whether tags are closed in order."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [unquote(value or "") for name, value in attrs if name in ("href", "src", "poster")]
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def links(text: str) -> list[str]:
    parser = Links()
    parser.feed(text)
    assert parser.open == []
    return parser.found


def a_run(folder: Path, metrics: Any = None, verdict: Any = None) -> Run:
    run = Run.create(folder, Path("/photos/<b>chairs</b>"), {"train": {"iterations": 3}})
    if metrics is not None:
        (folder / "evaluate").mkdir()
        (folder / "evaluate/metrics.json").write_text(json.dumps(metrics), encoding="utf-8")
    if verdict is not None:
        (folder / "evaluate").mkdir(exist_ok=True)
        (folder / "evaluate/verdict.json").write_text(json.dumps(verdict), encoding="utf-8")
    return run


def test_a_run_leaves_a_page_about_itself(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert enerf("run", toys, "--out", run, "--until", "train").code == 0
    (run / "report.html").unlink()
    assert enerf("report", run, "--json").objects[-1]["report"] == str(run / "report.html")
    assert "<td>missing</td>" in (run / "report.html").read_text(encoding="utf-8")
    assert enerf("run", "--out", run).code == 0
    text = (run / "report.html").read_text(encoding="utf-8")
    assert all(link.startswith("points/") for link in links(text))
    assert all(f"<td>{stage}</td><td>fresh</td>" in text for stage in ("poses", "train", "points"))
    written = (run / "report.html").stat().st_mtime_ns
    assert enerf("run", "--out", run).code == 0
    assert (run / "report.html").stat().st_mtime_ns == written  # nothing was done: nothing is written
    assert enerf("report", tmp_path).code == 2


def test_a_page_that_a_kill_prevented_is_written_by_the_next_run(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert enerf("run", toys, "--out", run).code == 0
    page_file = run / "report.html"
    page_file.unlink()
    assert enerf("run", "--out", run).code == 0
    assert page_file.is_file()
    text = page_file.read_bytes()
    page_file.write_bytes(b"of an older artifact")
    os.utime(page_file, ns=(1, 1))
    assert enerf("run", "--out", run).code == 0
    assert page_file.read_bytes() == text


POOR = {
    "network": {"psnr": 29.84, "ssim": 0.91, "psnr_colour_fitted": 30.5, "floaters": 0.01},
    "asset": {"psnr": 27.95, "ssim": 0.87, "psnr_colour_fitted": 28.25},
    "asset_with_network_background": {"psnr": 28.75, "ssim": 0.88},
    "gap": {"psnr": -1.89, "ssim": -0.04, "psnr_colour_fitted": -2.25},
    "holes": 0.034,
    "floaters": 0.051,
    "strips": [{"which": "worst", "view": "<b>.jpg", "network": {"psnr": 25.0, "ssim": 0.8}, "asset": {"psnr": 21.0, "ssim": 0.7}}],
    "views": [{"name": "a", "network": None, "asset": {"psnr": 27.95}, "gap": None, "holes": None, "floaters": None}],
}


PROBLEM = {"grade": "poor", "sentence": "It has <b>.", "cause": "Few rays.", "remedy": "Raise bake.max_mib.", "picture": "evaluate/strip_worst.png"}
VERDICT = {"grade": "poor", "summary": "Result: poor. It has <b>.", "blur": 0.03, "problems": [PROBLEM]}


def test_the_page_shows_the_asset_against_its_network_and_the_verdict(tmp_path: Path) -> None:
    run = a_run(tmp_path / "run", POOR, VERDICT)
    for name in ("strip_worst.png", "strip_best.png", "captured_path.mp4"):
        (run.path / "evaluate" / name).write_bytes(b"x")
    text = page(run, [])
    found = links(text)
    assert {"evaluate/strip_worst.png", "evaluate/strip_best.png", "evaluate/captured_path.mp4"} <= set(found)
    assert "evaluate/strip_median.png" not in found
    figures = ("-1.89", "-0.040", "3.40 %", "5.10 %", "28.75", "-2.25", "25.00", "0.800")
    figures += ("&lt;b&gt;.jpg", "It has &lt;b&gt;.", "Few rays.", "Raise bake.max_mib.")
    assert [each for each in figures if each not in text] == []


def write(run: Run, name: str, text: str) -> None:
    (run.path / name).parent.mkdir(exist_ok=True)
    (run.path / name).write_text(text, encoding="utf-8")


ODD = {
    "evaluate/metrics.json": [
        '{"network": {"psnr": 1e999}}',
        '{"network": {"psnr": ' + "9" * 400 + ', "ssim": 1}}', '{"network": {"psnr": ' + "9" * 5000 + "}}",
        '{"views": 7}', '{"views": [3]}', '{"views": [{"name": ["x"]}]}', '{"network": []}', '{"split": {}}', "[1]", "3", "[" * 100_000,
        '{"network": {"psnr": NaN}}', '{"gap": 3}', '{"holes": "many"}', '{"holes": 1e999}', '{"strips": {"which": "worst"}}', '{"strips": [{"which": 1}]}',
    ],
    "evaluate/verdict.json": ["[1]", '{"grade": 3}', '{"problems": {}}', '{"problems": [{"picture": []}]}', '"\\ud800"', "[" * 100_000],
    "poses/report.json": ['{"registered": 5}', '{"rejected": {"a": 1}}', '{"rejected": [{"name": 3}]}', '{"warnings": 4}', '"\\ud800"',
        '{"\\ud800": 1}', '{"reprojection_error": "far"}'],
    "bake/report.json": ["[]", '"text"', '{"voxels": ' + "9" * 5000 + "}", "\0"],
    "mesh/report.json": ["[]"],
}  # fmt: skip


def test_odd_documents_are_left_out_with_a_word(enerf: Enerf, tmp_path: Path) -> None:
    for name, texts in ODD.items():
        for k, text in enumerate(texts):
            run = a_run(tmp_path / f"{name.replace('/', ' ')} {k}")
            write(run, name, text)
            shown = page(run, [])
            links(shown)
            assert f"{name}: damaged (" in shown, text[:80]
    odd = tmp_path / "evaluate metrics.json 0"
    for command in (["report", run.path], ["status", run.path], ["inspect", odd], ["inspect", odd, "--json"]):
        result = enerf(*command)
        assert result.code == 0, result.err
    assert result.object["damaged"][0].startswith("evaluate/metrics.json: damaged (")


def test_the_page_shows_any_text_escaped(tmp_path: Path) -> None:
    odd = "a\x1b[31m\u202e\udcff\n<b>"
    run = a_run(tmp_path / "run\udcff\x1b", {"views": [{"name": odd, "network": {"psnr": 1, "ssim": 2}}]})
    run.settings = {odd: {odd: odd, "many": 10**400, "list": [odd]}}
    write(run, "poses/report.json", json.dumps({"rejected": [{"name": odd, "reason": odd}], "warnings": [odd]}))
    write(run, "bake/report.json", json.dumps({odd: odd, "large": 10**400}))
    (run.path / "train").mkdir()
    write(run, "train/previews/p\udcff\x1b.png", "x")
    text = page(run, [])
    text.encode("utf-8")
    assert "a\\x1b[31m\\u202e\\udcff\\n&lt;b&gt;" in text
    assert not any(character in text for character in "\x1b\u202e\udcff")
    assert "train/previews/p%FF%1B.png" in text


def test_a_stage_that_is_replaced_meanwhile_is_read_again(toys: Path, enerf: Enerf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    enerf("run", toys, "--out", tmp_path / "run")
    run = Run.open(tmp_path / "run")
    calls = []
    known = page_module._facts

    def replaced(*arguments: Any) -> Any:
        calls.append(1)
        if len(calls) == 1:
            (run.path / "points").rename(tmp_path / "old")
        if len(calls) == 3:
            (tmp_path / "old").rename(run.path / "points")
        return known(*arguments)

    monkeypatch.setattr(page_module, "_facts", replaced)
    text = write_report(run, TOYS).read_text(encoding="utf-8")
    assert "<td>points</td><td>fresh</td>" in text
    assert "points/points.ply" in text
    assert len(calls) == 6


def test_two_reports_at_once_do_not_disturb_each_other(tmp_path: Path) -> None:
    run = a_run(tmp_path / "run")
    with ThreadPoolExecutor(4) as pool:
        for future in [pool.submit(write_report, run, []) for _ in range(20)]:
            future.result()
    assert sorted(path.name for path in run.path.iterdir()) == [".lease", ".lock", "report.html", "run.json"]
    links((run.path / "report.html").read_text(encoding="utf-8"))
