"""The page about a run: it says what is there, points only to files that are, and is not led astray by what names hold."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from pipeline.run import Run
from tests.workflows.command import Enerf, Result
from workflows.report.page import page


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


def a_run(folder: Path, metrics: Any = None) -> Run:
    run = Run.create(folder, Path("/photos/<b>chairs</b>"), {"train": {"iterations": 3}})
    if metrics is not None:
        (folder / "evaluate").mkdir()
        (folder / "evaluate/metrics.json").write_text(json.dumps(metrics), encoding="utf-8")
    return run


def test_a_run_leaves_a_page_about_itself(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert enerf("run", toys, "--out", run).code == 0
    text = (run / "report.html").read_text(encoding="utf-8")
    assert all(link.startswith("points/") for link in links(text))
    for stage in ("poses", "train", "points"):
        assert re.search(rf"<td>{stage}</td><td>fresh</td>", text)
    written = (run / "report.html").stat().st_mtime_ns
    assert enerf("run", "--out", run).code == 0
    assert (run / "report.html").stat().st_mtime_ns == written  # nothing was done: nothing is written


def test_the_page_can_be_made_again(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    enerf("run", toys, "--out", run, "--until", "poses")
    (run / "report.html").unlink()
    result: Result = enerf("report", run, "--json")
    assert result.objects[-1]["report"] == str(run / "report.html")
    assert "<td>missing</td>" in (run / "report.html").read_text(encoding="utf-8")
    assert enerf("report", tmp_path).code == 2


def test_it_points_only_to_what_is_there(tmp_path: Path) -> None:
    run = a_run(tmp_path / "run")
    assert links(page(run, [])) == []
    for name in ("turntable/turntable.mp4", "turntable/frame_0000.png", "mesh/preview.png", "train/previews/preview 1.png", "bake/asset.nerftree"):
        (run.path / name).parent.mkdir(parents=True, exist_ok=True)
        (run.path / name).write_bytes(b"x")
    found = links(page(run, []))
    assert all((run.path / name).is_file() for name in found)
    assert {"turntable/turntable.mp4", "mesh/preview.png", "train/previews/preview 1.png", "bake/asset.nerftree"} <= set(found)


def test_names_and_reasons_are_text_not_markup(tmp_path: Path) -> None:
    view = {"name": "<script>x</script>.jpg", "network": None, "asset": {"psnr": 21.257, "ssim": 0.5}}
    run = a_run(tmp_path / "a run & more", {"network": {"psnr": 20.0, "ssim": 0.5}, "views": [view]})
    (run.path / "poses").mkdir()
    (run.path / "poses/report.json").write_text(json.dumps({"registered": [1], "rejected": [{"name": "<i>", "reason": "blur & fog"}]}), encoding="utf-8")
    (run.path / "bake").mkdir(exist_ok=True)
    (run.path / "bake/report.json").write_text(json.dumps({"voxels": 5, "resolution_decided_by": "pixels & room"}), encoding="utf-8")
    text = page(run, [])
    links(text)
    assert "pixels &amp; room" in text
    assert "<script" not in text
    assert "<b>chairs" not in text
    assert "blur &amp; fog" in text
    assert "21.26" in text
    assert "on 1 test view)" in text


def test_a_damaged_run_gets_a_page_too(tmp_path: Path) -> None:
    run = a_run(tmp_path / "run")
    for name in ("evaluate/metrics.json", "poses/report.json", "bake/report.json", "mesh/report.json"):
        (run.path / name).parent.mkdir(exist_ok=True)
        (run.path / name).write_text("{", encoding="utf-8")
    assert "not evaluated yet" in page(run, [])
