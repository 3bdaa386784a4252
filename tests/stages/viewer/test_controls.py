"""Every control of the page in a real browser: keys, one finger, cameras to click at, rotation by itself; and the page in all its shapes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.stages.viewer import browser
from tests.stages.viewer.browser import VIEW
from tests.stages.viewer.scenes import ORBIT, TREES, cameras_at, page_of

pytestmark = pytest.mark.skipif(browser.missing() is not None, reason=str(browser.missing()))

STATE = """async () => {
  const { viewer, controls } = await enerf.ready, { eye } = viewer, { azimuth, elevation, distance, target, held } = eye;
  return { azimuth, elevation, distance, target, held: held && held.name, mode: viewer.options.mode, spin: viewer.spin, frusta: controls.frusta };
}"""


@pytest.fixture(params=["asset", "Gaussians"])
def page_file(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Of a tree that keeps its orbit and five captured cameras."""
    tree = TREES["bounded"]().with_metadata(orbit=ORBIT)
    return page_of(request.param, tmp_path, tree, cameras=cameras_at(tree), title="a scene")


def state(page: browser.Page) -> Any:
    return page.page.evaluate(STATE)


def test_every_key_does_what_the_help_says(chromium: Any, page_file: Path) -> None:
    with browser.opened(chromium, page_file) as page:
        page.ready()
        page.page.locator("#scene").focus()
        began = state(page)

        def pressed(key: str) -> Any:
            page.page.keyboard.press(key)
            return state(page)

        for key, name, amount in (("Left", "azimuth", 0.1), ("Right", "azimuth", -0.1), ("Up", "elevation", 0.08), ("Down", "elevation", -0.08)):
            assert pressed(f"Arrow{key}")[name] == pytest.approx(began[name] + amount), key
            pressed("r")
        for key, factor in (("+", 0.9), ("=", 0.9), ("-", 1 / 0.9)):
            assert pressed(key)["distance"] == pytest.approx(began["distance"] * factor), key
            pressed("r")
        rotation = np.array(page.page.evaluate(VIEW)[0]["rotation"])
        for key, axis, sign in (("a", 0, -1), ("d", 0, 1), ("w", 1, -1), ("s", 1, 1)):  # right and down of the view
            moved = np.subtract(pressed(key)["target"], began["target"]) @ rotation
            assert np.argmax(np.abs(moved)) == axis, key
            assert sign * moved[axis] > 0.05, key
            np.testing.assert_allclose(np.delete(moved, axis), 0, atol=1e-9)
            assert pressed("r") == began, key
        assert [pressed(key)["held"] for key in (".", ".", ",", ",")] == ["0", "1", "0", "4"], "round and round"
        pressed("r")
        assert [pressed(key)["mode"] for key in "2341"] == [1, 2, 3, 0]
        assert [pressed("c")["frusta"] for _ in range(2)] == [True, False]
        assert [pressed(" ")["spin"] for _ in range(2)] == [True, False]
        pressed("r")
        with page.page.expect_download() as saved:
            page.page.keyboard.press("p")
        assert saved.value.suggested_filename == "a_scene.png"
        page.page.keyboard.press("?")
        assert page.page.is_visible("#help")
        assert pressed("ArrowLeft") == began, "the help is read meanwhile"
        page.page.keyboard.press("Escape")
        assert not page.page.is_visible("#help")
        assert page.console == []
