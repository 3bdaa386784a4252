"""Pages of fleets: what stands on them, that names stay text, that nothing is asked for from elsewhere, and that they are whole whenever they are read."""

from __future__ import annotations

import base64
import csv
import hashlib
import io
import os
import random
import re
import threading
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from pipeline.fleet.state import FleetState, SceneState
from pipeline.text import printable
from stages.figures.pareto import pareto_front, pareto_plot
from stages.figures.thumbnails import HEIGHT, WIDTH, write_thumbnail
from stages.io.pictures import UnreadableImage
from tests.workflows.fleet.fleets import NASTY, done, facts, fleet, mixed, with_pictures
from workflows.fleet.pages.comparison import best, mean_results, results, settings_of, write_comparison
from workflows.fleet.pages.index import index_page
from workflows.fleet.pages.spreadsheet import fleet_csv
from workflows.fleet.pages.updates import Pages


def test_the_page_has_what_the_state_has() -> None:
    state = mixed()
    state.note = f"no worker is there {NASTY}"
    found = facts(index_page(state, title="t", pictures={"scene-000": 7}, reports={"scene-000"}))
    assert found["note"] == printable(state.note)
    assert [scene["name"] for scene in found["scenes"]] == [scene.name for scene in state.scenes]
    expected = {"psnr": 20, "ssim": 0.9, "seconds": 10, "bytes": 1_000_000, "grade": "good", "result": "poor", "state": "done"}
    expected |= {"report": "scene-000/report.html", "picture": "thumbnails/scene-000.webp?7", "video": "scene-000/turntable/turntable.mp4"}
    assert found["scenes"][0].items() >= (expected | {"result_summary": printable(f"All is fog {NASTY}.")}).items()
    broken = dict.fromkeys(("result", "result_summary", "report", "picture", "video"))
    assert found["scenes"][3].items() >= (broken | {"state": "quarantined"}).items()
    assert found["bytes"] == sum(scene.bytes for scene in state.scenes)
    assert sum(found["totals"].values()) == 24


def test_names_and_messages_stay_text() -> None:
    page = index_page(mixed(), title=NASTY, comparison="comparison.html")
    assert page.count("<script") == 2, "the data and the script"
    assert "<b>" not in page
    assert "\x1b" not in page
    reason = facts(page)["scenes"][3]["reason"]
    assert reason.startswith("</script><script>alert")
    assert "\\x1b" in reason


def test_the_policy_allows_the_pages_own_script_and_style_alone() -> None:
    page = index_page(mixed(), title="t")
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', page)
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules["default-src"] == "'none'"
    scripts = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    styles = re.findall(r"<style>(.*?)</style>", page, re.DOTALL)
    assert len(scripts) == len(styles) == 1
    for rule, text in (("script-src", scripts[0]), ("style-src", styles[0])):
        assert rules[rule] == f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
    assert not re.search(r"(?:https?:)?//\w", re.sub(r'<script id="data".*?</script>', "", page, flags=re.DOTALL))


def test_figures_that_are_none_are_left_out() -> None:
    for metrics in (
        {},
        {"asset": None},
        {"asset": {"psnr": None}},
        {"asset": {"psnr": "x"}},
        {"asset": {"psnr": True}},
        {"asset": []},
        {"asset": {"psnr": 1e300}},
    ):
        scene = SceneState("a", "done", metrics=metrics, run="a")
        assert facts(index_page(fleet(scene), title="t"))["scenes"][0]["psnr"] is None
        assert fleet_csv(fleet(scene)).splitlines()[1].split(",")[3] == ""
    only_field = SceneState("a", "done", metrics={"network": {"psnr": 20.0, "ssim": None}}, run="a")
    assert facts(index_page(fleet(only_field), title="t"))["scenes"][0]["psnr"] == 20.0


def test_csv_reads_back() -> None:
    state = mixed()
    state.scenes[0].sweep = {"train.iterations": 2000}
    state.scenes[1].reason = "=1+1"
    rows = list(csv.DictReader(io.StringIO(fleet_csv(state), newline="")))
    assert [row["name"] for row in rows] == [scene.name for scene in state.scenes]
    assert (float(rows[0]["psnr"]), rows[0]["train.iterations"], rows[1]["train.iterations"]) == (20.0, "2000", "")
    assert rows[1]["reason"] == "'=1+1", "no spreadsheet takes it for a formula"
    assert rows[3]["reason"].startswith("</script>")
    assert "\x1b" not in fleet_csv(state)


def shown(fleet: Path, name: str) -> list[Any]:
    """This of each scene of the page."""
    return [scene[name] for scene in facts((fleet / "index.html").read_text("utf-8"))["scenes"]]


def test_pages_are_written_once_it_is_time_and_at_the_end(tmp_path: Path) -> None:
    state, page = mixed(), tmp_path / "index.html"
    with_pictures(tmp_path, state)
    pages = Pages(tmp_path)
    pages(state)
    assert pages.trouble is None
    state.scenes[0].stage = "bake"
    pages(state)
    pages.catch_up()
    assert shown(tmp_path, "stage")[0] is None, "not so soon"
    pages._next = 0.0
    pages.catch_up()
    written = page.stat().st_mtime_ns
    assert shown(tmp_path, "stage")[0] == "bake"
    pages._next = 0.0
    pages.catch_up()
    assert page.stat().st_mtime_ns == written, "nothing has changed"
    state.state = "done"
    pages(state)
    assert facts(page.read_text("utf-8"))["state"] == "done"
    assert {path.stem for path in (tmp_path / "thumbnails").iterdir()} == {scene.name for scene in state.scenes if scene.state == "done"}
    assert {path.name for path in tmp_path.iterdir() if path.is_file()} == {"index.html", "fleet.csv"}
    pages = Pages(tmp_path / "nowhere")
    pages(state)
    assert "nowhere" in (pages.trouble or ""), "it is told, not raised"


def test_thumbnails_and_links_are_of_what_is_there(tmp_path: Path) -> None:
    """A scene that failed may have a report of an earlier call; one that is done may have lost it."""
    state = fleet(done("a"), done("b"), done("c"))
    with_pictures(tmp_path, state)
    (tmp_path / "b" / "report.html").unlink()
    state.scenes[2].state, state.scenes[2].stages["turntable"].state = "failed", "failed"
    Pages(tmp_path)(state)
    assert shown(tmp_path, "report") == ["a/report.html", None, "c/report.html"]
    thumbnail = tmp_path / "thumbnails" / "a.webp"
    with Image.open(thumbnail) as image:
        assert image.size == (WIDTH, HEIGHT)
    assert thumbnail.stat().st_size < 10_000
    before = thumbnail.stat().st_ino
    Pages(tmp_path)(state)
    assert thumbnail.stat().st_ino == before
    os.utime(thumbnail, ns=(1, 1))
    Pages(tmp_path)(state)
    assert thumbnail.stat().st_ino != before, "it is made again of another picture only"


def test_pictures_that_are_none_end_nothing(tmp_path: Path) -> None:
    state = fleet(done("a"), done("b"), state="done")
    with_pictures(tmp_path, state)
    (tmp_path / "a" / "turntable" / "frame_0000.png").write_bytes(b"no picture")
    (tmp_path / "b" / "turntable" / "frame_0000.png").unlink()
    with pytest.raises(UnreadableImage):
        write_thumbnail(tmp_path / "a" / "turntable" / "frame_0000.png", tmp_path / "x.webp")
    pages = Pages(tmp_path)
    pages(state)
    assert (pages.trouble, shown(tmp_path, "picture")) == (None, [None, None])


def test_a_page_that_another_wrote_is_not_linked(tmp_path: Path) -> None:
    state = sweep()
    with_pictures(tmp_path, state)
    name = state.scenes[0].name
    (tmp_path / name / "report.html").write_text("<script>alert(1)</script>", "utf-8")
    Pages(tmp_path)(state)
    assert [link is None for link in shown(tmp_path, "report")] == [True] + [False] * 7
    assert f"{name}/report.html" not in (tmp_path / "comparison.html").read_text("utf-8")


def test_whoever_reads_the_page_finds_a_whole_one(tmp_path: Path) -> None:
    state, stopped, cut = mixed(50, state="done"), threading.Event(), []
    Pages(tmp_path)(state)

    def read() -> None:
        while not stopped.is_set():
            text = (tmp_path / "index.html").read_text("utf-8")
            if not text.endswith("</html>"):
                cut.append(len(text))

    reader = threading.Thread(target=read)
    reader.start()
    for _ in range(20):
        Pages(tmp_path)(state)
    stopped.set()
    reader.join()
    assert cut == []


def sweep() -> FleetState:
    """Two scenes, two settings of two values each; the first scene of each makes the poses."""
    scenes = []
    for number, name in enumerate("ab"):
        for iterations in (1, 2):
            for size in (8, 24):
                values = {"train.iterations": iterations, "bake.max_mib": size}
                scene = done(f"{name}--iterations-{iterations}--max_mib-{size}", 20 + number + iterations + size / 8, 40, size * 1_000_000, sweep=values)
                if iterations + size > 9:
                    scene.shares = {"poses": f"{name}--iterations-1--max_mib-8"}
                    scene.stages["poses"].seconds = 0.0
                scenes.append(scene)
    return fleet(*scenes, state="done")


def test_a_comparison_counts_what_was_shared_as_if_it_had_been_made() -> None:
    state = sweep()
    found = results(state, settings_of(state))
    assert [(each.scene, each.seconds) for each in found] == [("a", 40.0)] * 4 + [("b", 40.0)] * 4
    means = mean_results(found)
    assert [each.values for each in means] == [(1, 8), (1, 24), (2, 8), (2, 24)]
    assert [each.psnr for each in means] == [22.5, 24.5, 23.5, 25.5]
    assert (best(means, "seconds"), best(means, "megabytes")) == ({3}, {2, 3})
    state.scenes[0].state = "quarantined"
    found = results(state, settings_of(state))
    assert (found[0].psnr, mean_results(found), best(found, "seconds")) == (None, [], {7}), "one scene is no mean"


def test_a_page_of_a_sweep(tmp_path: Path) -> None:
    state = sweep()
    assert write_comparison(tmp_path, state, {scene.name for scene in state.scenes})
    page = (tmp_path / "comparison.html").read_text("utf-8")
    assert page.count('href="a--iterations-1--max_mib-8/report.html"') == 1
    for name in ("comparison/psnr_over_seconds.png", "comparison/psnr_over_megabytes.png"):
        assert f'<img src="{name}"' in page
    before = {path.name: path.read_bytes() for path in (tmp_path / "comparison").iterdir()}
    write_comparison(tmp_path, state)
    assert {path.name: path.read_bytes() for path in (tmp_path / "comparison").iterdir()} == before
    assert not write_comparison(tmp_path, mixed())
    for scene in state.scenes:
        scene.state, scene.metrics = "waiting", {}
    assert write_comparison(tmp_path, state)


def test_the_front_is_what_no_other_beats(tmp_path: Path) -> None:
    """Against the definition."""
    drawn = random.Random(5)
    for _ in range(100):
        points = [(drawn.randrange(6), drawn.randrange(6)) for _ in range(drawn.randrange(12))]

        def beats(one: tuple[int, int], other: tuple[int, int]) -> bool:
            return one != other and one[0] <= other[0] and one[1] >= other[1]

        expected = {place for place, point in enumerate(points) if not any(beats(other, point) for other in points)}
        front = pareto_front(points)
        assert set(front) == expected
        assert [points[place][0] for place in front] == sorted(points[place][0] for place in front)
    pareto_plot(tmp_path / "a.png", {"a": [(1, 20, r"$\frac{$"), (100, 30, "two")], "b": [(0.0, 1, "")]}, x_label="x", y_label="y")
    assert (tmp_path / "a.png").stat().st_size > 1000
