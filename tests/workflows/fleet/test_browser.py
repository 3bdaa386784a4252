"""The page of a fleet in a browser: sorted and filtered."""

from pathlib import Path
from typing import Any

import pytest

from tests.stages.viewer.browser import missing, opened
from tests.workflows.fleet.fleets import facts, mixed, with_pictures
from workflows.fleet.pages.updates import Pages

pytestmark = pytest.mark.skipif(missing() is not None, reason=str(missing()))

WIDE = {"viewport": {"width": 1200, "height": 700}}


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


def test_it_is_sorted_and_filtered(chromium: Any, page_file: Path) -> None:
    with opened(chromium, page_file, **WIDE) as each:
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
