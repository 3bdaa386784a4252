"""The page in a real browser, software rendering: pictures against the CPU renderer, hands on the page, files that it has to refuse."""

import base64
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.asset.format import serialize
from efficientnerf.asset.rendering import render
from stages.viewer.page import viewer_page
from tests.efficientnerf.hostile import HOSTILE
from tests.efficientnerf.trees import random_tree
from tests.stages.viewer import browser
from tests.stages.viewer.scenes import ORBIT, TREES, cameras_at, decibels, page_of, written

pytestmark = pytest.mark.skipif(browser.missing() is not None, reason=str(browser.missing()))


@pytest.mark.parametrize("kind", TREES)
def test_a_page_renders_what_the_cpu_renders(kind: str, chromium: Any, tmp_path: Path) -> None:
    from efficientnerf.asset.quantisation import compacted

    tree = compacted(TREES[kind]())
    with browser.opened(chromium, written(tmp_path, serialize(tree, "compact"))) as page:
        page.ready()
        for camera in cameras_at(tree):
            behind = None if tree.environment is not None else (0.2, 0.5, 0.9)
            found = page.rendered(camera, background=behind or (0, 0, 0), surroundings=behind is None)
            expected = render(tree, camera, background=behind).colour
            assert expected.std() > 0.02  # there is something to see
            assert decibels(found, expected) > 45
        camera = cameras_at(tree)[0]
        expected = render(tree, camera)
        hit = np.isfinite(expected.depth)
        assert 0.05 < hit.mean() < 0.98
        shown = page.rendered(camera, background=(0, 1, 0), surroundings=False, mode=1)
        assert ((shown != (0, 255, 0)).any(axis=-1) == hit).mean() > 0.99  # what it is thick enough to have a depth
        shown = page.rendered(camera, background=(0, 1, 0), surroundings=False, mode=2) / 127.5 - 1
        both = hit & (np.abs(np.linalg.norm(shown, axis=-1) - 1) < 0.03)
        assert both.sum() > 0.9 * hit.sum()
        assert np.median((shown * expected.normal).sum(axis=-1)[both]) > 0.95
        assert page.console == []
        assert [each for each in page.requests if not each.startswith(("file:", "data:"))] == []


@pytest.mark.parametrize("kind", ["asset", "Gaussians"])
def test_hands_on_the_page_move_the_picture(kind: str, chromium: Any, tmp_path: Path) -> None:
    tree = TREES["bounded"]().with_metadata(orbit=ORBIT)
    path = page_of(kind, tmp_path, tree, cameras=cameras_at(tree), photographs={"0": base64.b64decode(JPEG)}, title="a scene")
    with browser.opened(chromium, path, has_touch=True) as page:
        page.ready()
        mouse, keyboard = page.page.mouse, page.page.keyboard
        seen = [page.shown()]

        def changed(after: str) -> None:
            seen.append(page.shown())
            assert seen[-1] != seen[-2], after

        mouse.move(150, 120)
        mouse.down()
        mouse.move(210, 140, steps=3)
        mouse.up()
        changed("a drag")
        mouse.wheel(0, -300)
        changed("the wheel")
        page.page.locator("#scene").focus()
        keyboard.press("ArrowLeft")
        changed("a key")
        page.page.select_option("#mode", "2")
        changed("normals")
        page.page.select_option("#mode", "0")
        page.page.select_option("#background", "black")
        changed("a background")
        for touch, places in (("touchStart", [(100, 100), (200, 100)]), ("touchMove", [(80, 100), (220, 100)]), ("touchEnd", [])):
            points = [{"x": x, "y": y, "id": n} for n, (x, y) in enumerate(places)]
            if touch == "touchStart":
                session = page.page.context.new_cdp_session(page.page)
            session.send("Input.dispatchTouchEvent", {"type": touch, "touchPoints": points})
        changed("a pinch")
        page.page.click("#next")
        assert page.page.inner_text("#camera") == "0"
        assert page.page.is_visible("#photograph")
        page.page.fill("#blend", "50")
        assert page.page.eval_on_selector("#photograph", "each => each.style.clipPath") == "inset(0px 50% 0px 0px)"
        page.page.click("#home")
        page.page.select_option("#background", "scene")
        assert page.shown() == seen[0]
        with page.page.expect_download() as saved:
            page.page.click("#save")
        assert saved.value.suggested_filename == "a_scene.png"
        assert page.console == []
        assert [each for each in page.requests if not each.startswith(("file:", "data:", "blob:"))] == []


def test_a_page_refuses_what_verify_refuses(chromium: Any, tmp_path: Path) -> None:
    good = serialize(random_tree(1), "compact")
    with browser.opened(chromium, written(tmp_path, good)) as page:
        page.ready()
        assert page.page.evaluate("x => enerf.check(x)", base64.b64encode(good).decode()) is None
        files = {name: make() for name, (make, _) in HOSTILE.items()}
        texts = {name: base64.b64encode(file).decode() for name, file in files.items()}
        check = "async all => { const out = {}; for (const [n, x] of Object.entries(all)) out[n] = await enerf.check(x); return out; }"
        large = {name: text for name, text in texts.items() if len(text) > 10**6}
        assert len(large) >= 5
        said = page.page.evaluate(check, {name: text for name, text in texts.items() if name not in large})
        said |= {name: page.page.evaluate("x => enerf.check(x)", text) for name, text in large.items()}
        assert len(said) == len(HOSTILE) > 250
        assert [name for name, text in said.items() if text is None] == []
        other = [name for name, text in said.items() if "'enerf convert' makes it" in text]  # tensors of layouts that it does not read
        assert [name for name in other if b'compact"' in files[name]] == []
        start = 8 + int.from_bytes(good[:8], "little")
        rng = np.random.default_rng(0)
        for at in [*rng.integers(0, start, 20), *rng.integers(start, len(good), 20)]:  # every byte counts, but for spaces of the header
            altered = bytearray(good)
            altered[at] ^= 1
            text = page.page.evaluate("x => enerf.check(x)", base64.b64encode(bytes(altered)).decode())
            assert text is not None, int(at)
        assert page.console == []


@pytest.fixture
def small_parts(monkeypatch: pytest.MonkeyPatch) -> int:
    """Bytes in a part of the data: so few that a small page has several."""
    monkeypatch.setattr("stages.viewer.page.PART", 3 * 2**12)
    return 3 * 2**12


@pytest.mark.usefixtures("small_parts")
def test_a_page_of_parts_that_was_damaged_says_so(chromium: Any, tmp_path: Path) -> None:
    text = viewer_page(serialize(random_tree(1, shape=(6, 6, 6), degree=2, share=0.6), "compact")).decode()
    parts = re.findall(r'<script type="text/plain" data-part>.*?</script>\n', text)
    assert len(parts) >= 3
    at = text.index(parts[1]) + len(parts[1]) // 2
    damaged = {
        "without a part": text.replace(parts[1], ""),
        "without the last part": text.replace(parts[-1], ""),
        "with a part twice": text.replace(parts[0], parts[0] * 2),
        "with parts changed round": text.replace(parts[0] + parts[1], parts[1] + parts[0]),
        "with another digit": text[:at] + ("A" if text[at] != "A" else "B") + text[at + 1 :],
        "with what is no digit": text[:at] + "!" + text[at + 1 :],
        "with a digit fewer": text[:at] + text[at + 1 :],
        "with a part cut short": text.replace(parts[1], parts[1][: len(parts[1]) // 2] + "</script>\n"),
    }
    for name, page_text in damaged.items():
        assert page_text != text
        (tmp_path / "viewer.html").write_text(page_text)
        with browser.opened(chromium, tmp_path / "viewer.html") as page:
            assert "The asset in this page is refused" in page.refusal(), name
            assert page.console == [], name
    (tmp_path / "viewer.html").write_text(text[:at])  # so its script is not there
    with browser.opened(chromium, tmp_path / "viewer.html") as page:
        assert not page.page.is_visible("#late")
        page.page.wait_for_selector("#late", state="visible")
        assert "cut short" in page.page.inner_text("#late")
        assert page.page.evaluate("typeof enerf") == "undefined"


JPEG = (
    "/9j/4AAQSkZJRgABAQAAAQABAAD/2wBDAAMCAgICAgMCAgIDAwMDBAYEBAQEBAgGBgUGCQgKCgkICQkKDA8MCgsOCwkJDRENDg8QEBEQCgwSExIQEw8QEBD/wAALCAABAAEBAREA/8QAFAABAAAAAAAAAAAAAAAAAAAACf/"
    "EABQQAQAAAAAAAAAAAAAAAAAAAAD/2gAIAQEAAD8AVN//2Q=="
)  # fmt: skip
