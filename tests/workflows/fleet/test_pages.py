"""Pages of fleets: what stands on them, that names stay text, that nothing is asked for from elsewhere, and that they are whole whenever they are read."""

import base64
import hashlib
import random
import re
import threading
from pathlib import Path
from typing import Any

from pipeline.fleet.state import FleetState
from pipeline.text import printable
from stages.figures.pareto import pareto_front, pareto_plot
from tests.workflows.fleet.fleets import NASTY, done, facts, fleet, mixed, with_pictures
from workflows.fleet.pages.comparison import write_comparison
from workflows.fleet.pages.index import index_page
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
