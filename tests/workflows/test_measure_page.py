"""Measuring in the page of a run, in a real browser: places lie on the surface, and lengths are those of the command that it gives."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.asset import format
from efficientnerf.asset.rendering import render
from efficientnerf.asset.tree import tree_from_voxels
from efficientnerf.geometry.cameras import Camera, rays
from pipeline.run import Run
from stages.artifacts import BakeOutputs, PosesOutputs
from stages.io.scene import Orbit, Scene, View, save, similarity_to_json
from stages.viewer.page import viewer_page
from tests.efficientnerf.capture.rings import cameras_round
from tests.stages.balls import SIMILARITY
from tests.stages.viewer import browser
from tests.stages.viewer.browser import VIEW, WIDE
from tests.stages.viewer.scenes import ORBIT
from tests.workflows.command import Enerf
from workflows.report.viewer import page_bytes

pytestmark = pytest.mark.skipif(browser.missing() is not None, reason=str(browser.missing()))

HOME: dict[str, Any] = {**ORBIT, "centre": (0.0, 0.0, 0.0)}
CORNERS = np.array([[0.35, 0.3], [0.6, 0.45], [0.45, 0.7]])  # shares of the canvas


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with browser.chromium() as found:
        yield found


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run that made a solid block."""
    path = tmp_path / "a run"
    Run.create(path, Path("/photographs"))
    for outputs in (PosesOutputs.of_run(path), BakeOutputs.of_run(path)):
        outputs.folder.mkdir()
    views = [View(f"images/{c.name}", None, "train", SIMILARITY.camera(c), c, 1.0, 5.0) for c in cameras_round(4, np.random.default_rng(0))]
    bounds = np.array([[-1.0] * 3, [1.0] * 3])
    save(Scene("photographs", tuple(views), bounds, None, SIMILARITY, Orbit(**HOME), metric=True), PosesOutputs.of_run(path).folder)
    metadata = {"world_from_capture": similarity_to_json(SIMILARITY), "metric": True, "orbit": HOME}
    index = np.argwhere(np.ones((16, 16, 16), bool))
    tree = tree_from_voxels((4, 4, 4), 0.1, np.full(3, -0.8), index, np.full(4096, 100.0), np.zeros((4096, 1, 3), np.float32), brick=4, metadata=metadata)
    format.save(tree, BakeOutputs.of_run(path).asset, "compact")
    return path


def test_lengths_in_the_page_are_those_of_the_command(chromium: Any, enerf: Enerf, run: Path, tmp_path: Path) -> None:
    asset, file = BakeOutputs.of_run(run).asset, tmp_path / "page.html"
    file.write_bytes(viewer_page(page_bytes(run, asset), title=run.name))
    with browser.opened(chromium, file, **WIDE) as page:
        page.ready()
        page.page.click("#measure")
        page.shown()
        view, width, height = page.page.evaluate(VIEW)
        places = CORNERS * [width, height]
        for x, y in places:
            page.page.locator("#scene").click(position={"x": x, "y": y})
        lines = page.page.input_value("#lengths").splitlines()
        page.page.click("#undo")
        assert "in all" not in page.page.input_value("#lengths")
        page.page.click("#copy")
        page.page.click("#clear")
        page.page.keyboard.press("m")
        assert page.page.is_hidden("#measured")
        assert page.console == []
    program, verb, name, *given = shlex.split(lines[-1])
    assert (program, verb, name) == ("enerf", "measure", "a run")
    found = enerf("measure", run, *given, "--json")
    assert found.code == 0, found.err
    shown = [float(line.split(": ")[1].removesuffix(" m")) for line in lines[:3]]
    measured = [*(each["length"] for each in found.object["lengths"]), found.object["total"]]
    np.testing.assert_allclose(shown, measured, rtol=1e-3)

    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = view["rotation"], view["eye"]
    camera = Camera("eye", width, height, "PINHOLE", tuple(view["lens"]), pose)
    pixels = np.floor(places) + 0.5
    origins, directions = rays(camera, pixels)
    depth = render(format.load(asset), camera, background=(0, 0, 0)).depth
    along = np.array([depth[int(y), int(x)] for x, y in pixels]) / (directions @ camera.forward)
    on_surface = SIMILARITY.inverse().points(origins + along[:, None] * directions)
    picked = np.array([place["position"] for place in found.object["places"]])
    assert np.linalg.norm(picked - on_surface, axis=1).max() < 0.03, "half a pixel from where it was clicked, and no more"


def test_where_there_is_no_surface_nothing_is_measured(chromium: Any, run: Path, tmp_path: Path) -> None:
    file = tmp_path / "page.html"
    file.write_bytes(viewer_page(page_bytes(run, BakeOutputs.of_run(run).asset), title=run.name))
    with browser.opened(chromium, file, **WIDE) as page:
        page.ready()
        page.page.click("#measure")
        page.shown()
        page.page.locator("#scene").click(position={"x": 3, "y": 3})
        assert "no surface" in page.page.input_value("#lengths")
        assert page.console == []
