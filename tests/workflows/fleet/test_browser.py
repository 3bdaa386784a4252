"""The page of a fleet in a browser: sorted, filtered, walked through by keys; pictures as they come into sight, the turntable only where one points."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.stages.viewer.browser import chromium, missing, opened
from tests.workflows.fleet.fleets import mixed, with_pictures
from workflows.fleet.pages.updates import Pages

pytestmark = pytest.mark.skipif(missing() is not None, reason=str(missing()))

WIDE = {"viewport": {"width": 1200, "height": 700}}


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as found:
        yield found


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fleet")
    state = mixed(60)
    with_pictures(folder, state)
    Pages(folder)(state)
    return folder / "index.html"


def names(page: Any) -> list[str]:
    found: list[str] = page.evaluate("[...document.querySelectorAll('#rows tr:not(.details):not([hidden])')].map((row) => row.scene.name)")
    return found


def test_it_is_sorted_and_filtered(browser: Any, page_file: Path) -> None:
    with opened(browser, page_file, **WIDE) as each:
        page = each.page
        everything = names(page)
        assert everything == [f"scene-{number:03d}" for number in range(60)]
        page.click("th[data-key=psnr] button")
        ordered = page.evaluate("[...document.querySelectorAll('#rows tr')].map((row) => row.scene.psnr)")
        known = [value for value in ordered if value is not None]
        assert known == sorted(known, reverse=True)
        assert ordered[len(known) :] == [None] * (60 - len(known)), "what has no figure comes last, whatever the direction"
        page.click("th[data-key=psnr] button")
        assert page.get_attribute("th[data-key=psnr]", "aria-sort") == "ascending"
        assert page.evaluate("document.querySelector('#rows tr').scene.psnr") == min(known)
        page.fill("#filter", "alert quarantined")
        assert names(page) == sorted(names(page))
        assert len(names(page)) == 6
        page.fill("#filter", "")
        page.click("button[data-state=waiting]")
        assert len(names(page)) == 6
        page.reload()
        assert len(names(page)) == 6, "the address keeps what was chosen"
        assert page.get_attribute("th[data-key=psnr]", "aria-sort") == "ascending"
        assert each.console == []


def test_keys(browser: Any, page_file: Path) -> None:
    with opened(browser, page_file, **WIDE) as each:
        page = each.page
        for key in ("j", "j", "ArrowDown", "k"):
            page.keyboard.press(key)
        assert page.evaluate("document.activeElement.scene.name") == "scene-001"
        page.keyboard.press("j")
        page.keyboard.press("j")
        page.keyboard.press(" ")
        assert "last" in page.inner_text("tr.details pre")
        page.keyboard.press(" ")
        assert page.query_selector("tr.details") is None
        page.keyboard.press("/")
        page.keyboard.type("scene-004")
        assert names(page) == ["scene-004"]
        page.keyboard.press("Escape")
        assert len(names(page)) == 60
        page.keyboard.press("j")
        (page_file.parent / "scene-000" / "report.html").write_text("the report")
        page.keyboard.press("Enter")
        page.wait_for_url("**/scene-000/report.html")


def test_only_what_is_seen_is_asked_for(browser: Any, page_file: Path) -> None:
    with opened(browser, page_file, **WIDE) as each:
        each.page.wait_for_function("document.querySelector('.thumb img').complete")
        assert each.page.evaluate("document.querySelector('.thumb img').naturalWidth") == 192
        assert not any(".mp4" in url for url in each.requests)
        assert len([url for url in each.requests if ".webp" in url]) < 42, "those far below are not"
        each.page.hover(".thumb:has(img) div")
        each.page.wait_for_selector("video")
        assert [url for url in each.requests if ".mp4" in url] == [(page_file.parent / "scene-000/turntable/turntable.mp4").as_uri()]
        each.page.mouse.move(900, 5)
        each.page.wait_for_selector("video", state="detached")
        assert all(url.startswith(page_file.parent.as_uri()) or url == "data:," for url in each.requests)


def test_nothing_runs_over_a_narrow_page(browser: Any, page_file: Path) -> None:
    for width in (360, 700, 1200):
        with opened(browser, page_file, viewport={"width": width, "height": 700}, color_scheme="dark") as each:
            each.page.click("button.more >> nth=3")
            assert each.page.evaluate("document.documentElement.scrollWidth") <= width
            assert each.console == []
