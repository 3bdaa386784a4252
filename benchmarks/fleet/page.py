"""index.html of made-up fleets in headless Chromium: what it weighs, what loading it takes, and how it looks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tests.stages.viewer.browser import chromium, opened
from tests.workflows.fleet.fleets import mixed, with_pictures
from workflows.fleet.pages.updates import Pages

COUNTS = (24, 1000)
WIDTHS = {"wide": 1280, "narrow": 390}
REPEATS = 5


def look(folder: Path) -> list[dict[str, Any]]:
    """A row for each number of scenes; screenshots in the folder."""
    with chromium() as browser:
        return [_measured(browser, folder, count) for count in COUNTS]


def _measured(browser: Any, folder: Path, count: int) -> dict[str, Any]:
    fleet = folder / f"fleet-{count}"
    if not fleet.exists():
        fleet.mkdir(parents=True)
        state = mixed(count, state="failed")
        with_pictures(fleet, state)
        Pages(fleet)(state)
    page = fleet / "index.html"
    loads = [_loaded(browser, page) for _ in range(REPEATS)]
    for width, pixels in WIDTHS.items():
        for scheme in ("light", "dark"):
            with opened(browser, page, viewport={"width": pixels, "height": 900}, color_scheme=scheme) as each:
                each.page.click("button.more >> nth=3")
                each.page.wait_for_function("[...document.querySelectorAll('.thumb img')].slice(0, 5).every((image) => image.complete)")
                each.page.screenshot(path=folder / f"{count}-{width}-{scheme}.png")
                assert each.console == []
    middle = {name: sorted(load[name] for load in loads)[REPEATS // 2] for name in loads[0]}
    return {"scenes": count, "bytes": page.stat().st_size, "csv_bytes": (fleet / "fleet.csv").stat().st_size, **middle}


def _loaded(browser: Any, path: Path) -> dict[str, float]:
    """Seconds from the start to the end of the load event, by the clock; processor time of the page's process, and what it asked for."""
    with opened(browser, path, viewport={"width": 1280, "height": 900}) as each:
        session = each.page.context.new_cdp_session(each.page)
        session.send("Performance.enable")
        figures = {entry["name"]: entry["value"] for entry in session.send("Performance.getMetrics")["metrics"]}
        ended = each.page.evaluate("performance.getEntriesByType('navigation')[0].loadEventEnd") / 1000
        return {"load_seconds": ended, "cpu_seconds": figures["ProcessTime"], "requests": len(each.requests)}
