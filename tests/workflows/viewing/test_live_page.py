"""The page of `enerf view RUN --serve` in a real browser: it shows a run as it is made, and follows it."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.asset.format import save
from pipeline.run import Run
from stages.artifacts import BakeOutputs
from stages.io.png import write_png
from tests.efficientnerf.trees import random_tree
from tests.stages.viewer.browser import Page, missing, opened
from tests.workflows.viewing.growing import TRAIN, put, scratch
from workflows.viewing.server import LOOPBACK, Server
from workflows.viewing.serving import RunSite, asset_site

pytestmark = pytest.mark.skipif(missing() is not None, reason=str(missing()))


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return Run.create(tmp_path / "a <b>run", Path("/photographs"), {})


@pytest.fixture
def server(run: Run, tmp_path: Path) -> Iterator[Server]:
    (tmp_path / "pages").mkdir()
    with Server(RunSite(run.path, (TRAIN,), tmp_path / "pages"), LOOPBACK, 0) as made:
        threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        yield made
        made.shutdown()


@pytest.fixture
def picture(tmp_path: Path) -> bytes:
    """A PNG of 12 x 8."""
    write_png(np.full((8, 12, 3), 90, np.uint8), tmp_path / "preview.png")
    return (tmp_path / "preview.png").read_bytes()


def until(page: Page, what: str) -> None:
    """Wait for it; a function of the page's own that waited would be refused by its policy."""
    end = time.monotonic() + 60
    while not page.page.evaluate(what):
        assert time.monotonic() < end, what
        page.page.wait_for_timeout(50)


def points(page: Page, line: str) -> int:
    return len((page.page.get_attribute(f"svg polyline.{line}", "points") or "").split())


def test_it_follows_a_run(chromium: Any, run: Run, server: Server, picture: bytes) -> None:
    with opened(chromium, server.url, viewport={"width": 900, "height": 700}) as live:
        page = live.page
        until(live, "document.querySelectorAll('#stages li').length === 1")
        assert page.get_attribute("#stages li", "class") == "missing"
        assert page.inner_text("#name") == "a <b>run", "names are text"
        assert page.query_selector("section.training") is None
        assert not page.is_visible("#asset")
        put(scratch(run), 7, [3, 5], picture)
        until(live, "document.querySelector('svg polyline.first')")
        assert page.get_attribute("#stages li", "class") == "partial"
        assert all(figure in page.inner_text(".now") for figure in ("step 6", "0.6 s", "10.06 dB", "9.50 dB"))
        assert (points(live, "first"), points(live, "second"), page.locator("svg circle").count()) == (7, 2, 2)
        until(live, "document.querySelector('.preview img').naturalWidth === 12")
        put(scratch(run), 12, [3, 5, 9], picture)
        until(live, "document.querySelector('.preview label span').textContent === 'step 9'")
        assert (points(live, "first"), points(live, "second")) == (12, 3)
        page.locator(".preview input").fill("0")
        put(scratch(run), 20, [3, 5, 9, 15], picture)
        until(live, "document.querySelector('svg polyline.first').getAttribute('points').split(' ').length === 20")
        assert page.inner_text(".preview label span") == "step 3", "who looks at an earlier one is left there"
        assert live.console == []
        expected = {"", "live.css", "live.js", "status.json", *(f"previews/train/preview_{step:06d}.png" for step in (3, 5, 9))}
        assert {url.removeprefix(server.url).partition("?")[0] for url in live.requests if url != "data:,"} == expected
        server.shutdown()
        server.server_close()
        page.wait_for_selector("#trouble", state="visible", timeout=60_000)
        assert page.locator("#stages li").count() == 1, "what was seen last stays when nobody answers any more"


def test_it_shows_the_asset_once_there_is_one_and_another_when_asked(chromium: Any, run: Run, server: Server) -> None:
    with opened(chromium, server.url, viewport={"width": 900, "height": 900}) as live:
        until(live, "document.querySelectorAll('#stages li').length === 1")
        asset = BakeOutputs.of_run(run.path).asset
        asset.parent.mkdir()
        first, other = random_tree(1), random_tree(2, shape=(6, 6, 6))
        save(first, asset)
        live.page.wait_for_selector("#asset", state="visible", timeout=60_000)
        shown = live.page.frame_locator("#viewer")
        shown.locator("body.ready").wait_for(timeout=60_000)
        said = shown.locator("#facts-line").inner_text()
        assert said.startswith(f"{len(first.density_values):,} voxels")
        assert not live.page.is_visible("#again")
        asset.unlink()
        save(other, asset)
        live.page.wait_for_selector("#again", state="visible", timeout=60_000)
        assert shown.locator("#facts-line").inner_text() == said, "nothing is taken away from whoever looks at it"
        live.page.click("#again")
        shown.locator("#facts-line", has_text=f"{len(other.density_values):,} voxels").wait_for(timeout=60_000)
        assert live.console == []


def test_a_page_that_another_put_in_its_place_runs_nothing(chromium: Any, tmp_path: Path) -> None:
    page = tmp_path / "viewer.html"
    page.write_text("<!doctype html><title>mine</title><body><script>document.title = 'run'</script><img src=x onerror='document.title = 2'>", encoding="utf-8")
    with Server(asset_site(page), LOOPBACK, 0) as made:
        threading.Thread(target=made.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        with opened(chromium, made.url) as shown:
            shown.page.wait_for_timeout(200)
            assert shown.page.title() == "mine"
        made.shutdown()
