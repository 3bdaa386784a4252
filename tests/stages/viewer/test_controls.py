"""Every control of the page in a real browser: keys, one finger, cameras to click at, rotation by itself; and the page in all its shapes."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.asset.conversion import with_degree
from efficientnerf.asset.format import serialize
from efficientnerf.asset.rendering import render
from efficientnerf.geometry.cameras import Camera, project
from tests.stages.viewer import browser
from tests.stages.viewer.browser import VIEW, WIDE
from tests.stages.viewer.scenes import ORBIT, TREES, cameras_at, decibels, page_of, written

pytestmark = pytest.mark.skipif(browser.missing() is not None, reason=str(browser.missing()))

STATE = """async () => {
  const { viewer, controls } = await enerf.ready, { eye } = viewer, { azimuth, elevation, distance, target, held } = eye;
  return { azimuth, elevation, distance, target, held: held && held.name, mode: viewer.options.mode, spin: viewer.spin, frusta: controls.frusta };
}"""
INKED = """([x, y]) => {
  const copy = new OffscreenCanvas(9, 9).getContext("2d");
  copy.drawImage(document.getElementById("over"), x - 4, y - 4, 9, 9, 0, 0, 9, 9);
  return copy.getImageData(0, 0, 9, 9).data.filter((_, n) => n % 4 === 3).some((alpha) => alpha > 0);
}"""
BOXES = "[...document.querySelectorAll('header, nav, nav *:not(option), main, dialog[open]')].map((x) => x.getBoundingClientRect())"


@pytest.fixture(params=["asset", "Gaussians"])
def page_file(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Of a tree that keeps its orbit and five captured cameras."""
    tree = TREES["bounded"]().with_metadata(orbit=ORBIT)
    return page_of(request.param, tmp_path, tree, cameras=cameras_at(tree), title="a scene")


def state(page: browser.Page) -> Any:
    return page.page.evaluate(STATE)


def seen_at(page: browser.Page, camera: Camera) -> tuple[float, float]:
    """Where on the page's canvas a camera's centre shows; nan behind the eye."""
    view, width, height = page.page.evaluate(VIEW)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = view["rotation"], view["eye"]
    x, y = project(Camera("eye", width, height, "PINHOLE", tuple(view["lens"]), pose), camera.centre[None])[0][0].tolist()
    return x, y


def test_colours_of_degree_0_are_those_of_the_asset_without_the_others(chromium: Any, tmp_path: Path) -> None:
    from efficientnerf.asset.quantisation import compacted

    for kind, behind in (("bounded", (0.2, 0.5, 0.9)), ("whole", None)):
        tree = compacted(TREES[kind]())
        with browser.opened(chromium, written(tmp_path, serialize(tree, "compact"))) as page:
            page.ready()
            for camera in cameras_at(tree)[:2]:
                found = page.rendered(camera, background=behind or (0, 0, 0), surroundings=behind is None, mode=3)
                expected = render(with_degree(tree, 0), camera, background=behind).colour
                assert decibels(found, expected) > 45
                assert decibels(found, render(tree, camera, background=behind).colour) < 35, "the scene has colours that change with the view"
            assert page.console == []


def test_a_click_at_a_captured_camera_goes_there(chromium: Any, page_file: Path) -> None:
    cameras = cameras_at(TREES["bounded"]())
    with browser.opened(chromium, page_file, **WIDE) as page:
        page.ready()
        page.shown()
        at = {camera.name: seen_at(page, camera) for camera in cameras}
        inside = {name: (x, y) for name, (x, y) in at.items() if 10 < x < 630 and 10 < y < page.page.locator("#scene").bounding_box()["height"] - 10}
        assert len(inside) >= 2
        name, place = max(inside.items(), key=lambda each: min(np.hypot(*np.subtract(each[1], other)) for one, other in inside.items() if one != each[0]))
        assert not page.page.evaluate(INKED, place)
        page.page.locator("#scene").click(position={"x": place[0], "y": place[1]})
        assert state(page)["held"] is None, "those that are not shown are not clicked at"
        page.page.click("#frusta")
        assert page.page.get_attribute("#frusta", "aria-pressed") == "true"
        page.shown()
        assert all(page.page.evaluate(INKED, each) for each in inside.values())
        page.page.locator("#scene").click(position={"x": place[0], "y": place[1]})
        assert state(page)["held"] == name
        assert page.page.inner_text("#camera") == name
        camera = next(each for each in cameras if each.name == name)
        view = page.page.evaluate(VIEW)[0]
        np.testing.assert_allclose(np.column_stack([view["rotation"], view["eye"]]), camera.world_from_camera[:3], atol=1e-9)
        there = page.shown()
        page.page.click("#home")
        for key in ",.":  # to the one before it, and back
            page.page.keyboard.press(key)
        assert state(page)["held"] == name
        assert page.shown() == there
        assert page.console == []


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


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_runs_over_the_page_s_sides(scheme: str, chromium: Any, page_file: Path) -> None:
    for width in (320, 1200):
        with browser.opened(chromium, page_file, viewport={"width": width, "height": 700}, color_scheme=scheme) as page:
            page.ready()
            page.page.click("#next")
            for _ in range(2):  # without and with the help
                assert page.page.evaluate("document.documentElement.scrollWidth") <= width
                boxes = page.page.evaluate(BOXES)
                assert max(box["right"] for box in boxes) <= width
                assert min(box["left"] for box in boxes) >= 0
                page.page.keyboard.press("?")
                page.page.wait_for_selector("#help", state="visible")
            assert page.page.locator("#scene").bounding_box()["height"] > 350, "most of the page is the scene"
            paper, ink = page.page.evaluate("(({ backgroundColor, color }) => [backgroundColor, color])(getComputedStyle(document.body))")
            means = [np.mean([int(x) for x in each[4:-1].split(",")]) for each in (paper, ink)]
            assert means[0] > 200 > 100 > means[1] if scheme == "light" else means[1] > 200 > 100 > means[0]
            assert page.console == []
