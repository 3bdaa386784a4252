"""Chromium for the tests of pages: one process for all of them, or the reason why there is none."""

import base64
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.geometry.cameras import Camera

CHROMIUM = next((found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), None)

RENDER = """async ([pose, lens, width, height, options]) => {
  await enerf.setCamera(pose, lens);
  await enerf.setOptions(options);
  const found = await enerf.render(width, height);
  return btoa(Array.from(found, (x) => String.fromCharCode(x)).join(""));
}"""

VIEW = "async () => { const { viewer } = await enerf.ready, { width, height } = viewer.canvas; return [viewer.eye.view(width, height), width, height]; }"
WIDE = {"viewport": {"width": 640, "height": 480}}

RESTED = """async () => {
  const { viewer } = await enerf.ready, frame = () => new Promise((done) => requestAnimationFrame(done));
  for (let still = 0; still < 3; await frame()) still = viewer.state === "done" ? still + 1 : 0;
}"""


def missing() -> str | None:
    """Why no browser can be driven here; None where one can."""
    try:
        import playwright.sync_api  # noqa: F401
    except ImportError:
        return "playwright is not installed"
    return None if CHROMIUM else "there is no Chromium"


@dataclass
class Page:
    """A page that is open, and what it did: lines of errors and warnings on its console, addresses that it asked for."""

    page: Any
    console: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def ready(self) -> None:
        """Wait until the scene is shown; an error of the page's raises."""
        self.page.evaluate("enerf.ready.then(() => null)")

    def refusal(self) -> str:
        """The message of a page that shows no scene."""
        self.page.evaluate("enerf.ready.then(() => { throw new Error('it is shown') }, () => null)")
        return str(self.page.inner_text("#status"))

    def rendered(self, camera: Camera, **options: Any) -> np.ndarray:
        """(H, W, 3) uint8: what the page renders for a camera."""
        lens = camera.intrinsics
        arguments = [camera.world_from_camera[:3].tolist(), [lens[key] for key in ("fx", "fy", "cx", "cy")], camera.width, camera.height, options]
        raw = base64.b64decode(self.page.evaluate(RENDER, arguments))
        return np.frombuffer(raw, np.uint8).reshape(camera.height, camera.width, 4)[..., :3]

    def shown(self) -> bytes:
        """The canvas as it is once it rests."""
        self.page.evaluate(RESTED)
        return bytes(self.page.locator("#scene").screenshot())


@contextmanager
def chromium() -> Iterator[Any]:
    """The browser of playwright."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-dev-shm-usage"])
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def opened(browser: Any, place: Path | str, **options: Any) -> Iterator[Page]:
    """A page from a file or an address, in a context of its own."""
    context = browser.new_context(**{"viewport": {"width": 320, "height": 300}, **options})
    page = Page(context.new_page())
    page.page.on("console", lambda each: page.console.append(each.text) if each.type in ("error", "warning") and "ReadPixels" not in each.text else None)
    page.page.on("pageerror", lambda error: page.console.append(str(error)))
    page.page.on("request", lambda request: page.requests.append(request.url))
    page.page.goto(place if isinstance(place, str) else place.as_uri())
    try:
        yield page
    finally:
        context.close()
