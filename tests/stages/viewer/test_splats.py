"""The page of Gaussians: as the CPU renders what the file holds, in another frame, and refused where it is damaged."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.asset.format import contents, save
from efficientnerf.asset.region import inside_share
from efficientnerf.geometry.cameras import Similarity
from efficientnerf.splats.rendering import render
from stages.formats.exporters import SPLAT_EXPORTERS
from stages.formats.exporters.glb import gltf_from_capture
from stages.formats.exporters.splats.frames import moved
from stages.formats.exporters.writing import source_frame
from stages.viewer.page import splats_page
from tests.efficientnerf.trees import random_cascades
from tests.stages.formats.gaussians import read_spz, scattered
from tests.stages.viewer import browser
from tests.stages.viewer.scenes import REGION, cameras_at, decibels

TURN = np.array([[0.0, 0.6, -0.8], [1.0, 0.0, 0.0], [0.0, -0.8, -0.6]])
FRAME = {"scale": 0.3, "rotation": TURN.tolist(), "translation": [0.1, 0.9, -0.5]}


@pytest.fixture(params=[0, 2, 3])
def made(request: pytest.FixtureRequest, tmp_path: Path) -> Any:
    """A tree, the Gaussians in its frame, and the arguments of their page."""
    tree = random_cascades(3, degree=1, region=REGION).with_metadata(world_from_capture=FRAME)
    save(tree, tmp_path / "a.nerftree", "sparse")
    frame = source_frame(tree.metadata)
    SPLAT_EXPORTERS[".spz"](scattered(1500, request.param), tmp_path / "a.spz", frame)
    gaussians = moved(moved(read_spz(tmp_path / "a.spz")[1], Similarity(1.0, gltf_from_capture(frame.up).T, np.zeros(3))), frame.world_from_capture)
    return tree, gaussians, ((tmp_path / "a.spz").read_bytes(), contents(tmp_path / "a.nerftree")[0])


@pytest.mark.skipif(browser.missing() is not None, reason=str(browser.missing()))
def test_a_page_renders_what_the_cpu_renders(made: Any, chromium: Any, tmp_path: Path) -> None:
    tree, gaussians, arguments = made
    path = tmp_path / "viewer.html"
    path.write_bytes(splats_page(*arguments, cameras=cameras_at(tree), asset="viewer_asset.html"))
    subject = replace(gaussians, opacities=(gaussians.opacities * inside_share(REGION, gaussians.means)).clip(1e-6).astype(np.float32))
    with browser.opened(chromium, path) as page:
        page.ready()
        assert page.page.get_attribute("#other", "href") == "viewer_asset.html"
        for shown in (gaussians, subject):
            for camera in cameras_at(tree)[:3]:
                expected = render(shown, camera, (0.2, 0.5, 0.9)).colour
                assert expected.std() > 0.02
                assert decibels(page.rendered(camera, background=(0.2, 0.5, 0.9)), expected) > 40
            page.page.select_option("#subject", "subject")
            page.page.wait_for_selector("#loading", state="hidden")
            page.page.wait_for_function("enerf.ready.then(({viewer}) => viewer.renderer.region !== null)")
        assert page.page.evaluate("enerf.ready.then(({viewer}) => viewer.renderer.worker !== null)")
        page.page.click("#spin")
        page.page.wait_for_function("enerf.ready.then(({viewer}) => viewer.frames.length > 0)")
        assert page.console == []
        assert [each for each in page.requests if not each.startswith(("file:", "data:", "blob:"))] == []
    text = path.read_text()
    path.write_text(text.replace('"sha256":"', '"sha256":"0'))
    with browser.opened(chromium, path) as page:
        assert "SHA-256" in page.refusal()
