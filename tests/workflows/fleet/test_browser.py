"""The page of a fleet in a browser: sorted, filtered, walked through by keys; pictures as they come into sight, the turntable of one scene at a time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.stages.viewer.browser import chromium, missing, opened
from tests.workflows.fleet.fleets import facts, mixed, with_pictures
from workflows.fleet.pages.updates import Pages

pytestmark = pytest.mark.skipif(missing() is not None, reason=str(missing()))

WIDE = {"viewport": {"width": 1200, "height": 700}}


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as found:
        yield found


@pytest.fixture(scope="module", params=(24, 1000))
def page_file(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fleet")
    state = mixed(request.param)
    with_pictures(folder, state)
    Pages(folder)(state)
    return folder / "index.html"


def totals(page_file: Path) -> dict[str, int]:
    """State -> scenes."""
    found: dict[str, int] = facts(page_file.read_text(encoding="utf-8"))["totals"]
    return found


def names(page: Any) -> list[str]:
    found: list[str] = page.evaluate("[...document.querySelectorAll('#rows tr:not(.details):not([hidden])')].map((row) => row.scene.name)")
    return found


def test_it_is_sorted_and_filtered(browser: Any, page_file: Path) -> None:
    with opened(browser, page_file, **WIDE) as each:
        page = each.page
        everything = names(page)
        count = sum(totals(page_file).values())
        assert everything == [f"scene-{number:03d}" for number in range(count)]
        page.click("th[data-key=psnr] button")
        ordered = page.evaluate("[...document.querySelectorAll('#rows tr')].map((row) => row.scene.psnr)")
        known = [value for value in ordered if value is not None]
        assert known == sorted(known, reverse=True)
        assert ordered[len(known) :] == [None] * (count - len(known)), "what has no figure comes last, whatever the direction"
        page.click("th[data-key=psnr] button")
        assert page.get_attribute("th[data-key=psnr]", "aria-sort") == "ascending"
        assert page.evaluate("document.querySelector('#rows tr').scene.psnr") == min(known)
        page.fill("#filter", "alert quarantined")
        assert names(page) == sorted(names(page))
        assert len(names(page)) == totals(page_file)["quarantined"]
        page.fill("#filter", "")
        page.click("button[data-state=waiting]")
        assert len(names(page)) == totals(page_file)["waiting"]
        page.reload()
        assert len(names(page)) == totals(page_file)["waiting"], "the address keeps what was chosen"
        assert page.get_attribute("th[data-key=psnr]", "aria-sort") == "ascending"
        assert each.console == []


def test_keys(browser: Any, page_file: Path) -> None:
    with opened(browser, page_file, **WIDE) as each:
        page = each.page
        for key in ("j", "j", "ArrowDown", "k"):
            page.keyboard.press(key)
        assert page.evaluate("document.activeElement.scene.name") == "scene-001"
        for key in ("j", "j", " "):
            page.keyboard.press(key)
        assert "last" in page.inner_text("tr.details pre")
        page.keyboard.press(" ")
        assert page.query_selector("tr.details") is None
        page.keyboard.press("/")
        page.keyboard.type("scene-004")
        assert names(page) == ["scene-004"]
        page.keyboard.press("Escape")
        assert len(names(page)) == sum(totals(page_file).values())
        for key in ("j", "Enter"):
            page.keyboard.press(key)
        page.wait_for_url("**/scene-000/report.html")
    with opened(browser, page_file, viewport={"width": 360, "height": 700}, color_scheme="dark") as each:
        each.page.click("button.more >> nth=3")
        assert each.page.evaluate("document.documentElement.scrollWidth") <= 360
        assert each.console == []


def test_only_what_is_seen_is_asked_for(browser: Any, page_file: Path) -> None:
    with opened(browser, page_file, **WIDE) as each:
        each.page.wait_for_function("document.querySelector('.thumb img').complete")
        assert each.page.evaluate("document.querySelector('.thumb img').naturalWidth") == 192
        assert not any(".mp4" in url for url in each.requests)
        assert len([url for url in each.requests if ".webp" in url]) <= 42, "those far below are not"
        each.page.hover(".thumb:has(img) div")
        each.page.wait_for_selector("video")
        assert [url for url in each.requests if ".mp4" in url] == [(page_file.parent / "scene-000/turntable/turntable.mp4").as_uri()]
        each.page.mouse.move(900, 5)
        each.page.wait_for_selector("video", state="detached")
        assert all(url.startswith(page_file.parent.as_uri()) or url == "data:," for url in each.requests)


def test_a_turntable_plays_where_the_focus_is(browser: Any, page_file: Path) -> None:
    playing = "[...document.querySelectorAll('video')].map((video) => video.closest('tr').scene.name)"
    with opened(browser, page_file, **WIDE) as each:
        for name in ("scene-000", "scene-001"):
            each.page.keyboard.press("j")
            each.page.wait_for_selector("tr:focus video")
            assert each.page.evaluate(playing) == [name]
        each.page.keyboard.press("Tab")
        assert each.page.evaluate(playing) == ["scene-001"], "its report has the focus"
        each.page.keyboard.press("/")
        assert each.page.evaluate(playing) == []
    with opened(browser, page_file, reduced_motion="reduce", **WIDE) as each:
        each.page.keyboard.press("j")
        assert each.page.evaluate("document.activeElement.scene.name") == "scene-000"
        assert each.page.evaluate(playing) == [], "nothing moves unasked"
        each.page.hover(".thumb:has(img) div")
        assert each.page.evaluate(playing) == ["scene-000"]


def test_a_turntable_plays_where_one_taps(browser: Any, page_file: Path) -> None:
    with opened(browser, page_file, has_touch=True, **WIDE) as each:
        each.page.tap(".thumb:has(img) div >> nth=0")
        each.page.wait_for_selector("video")
        each.page.tap(".thumb:has(img) div >> nth=1")
        each.page.wait_for_function("document.querySelector('video')?.closest('tr').scene.name === 'scene-001'")
        assert each.page.evaluate("document.querySelectorAll('video').length") == 1
        each.page.tap("h1")
        each.page.wait_for_selector("video", state="detached")
