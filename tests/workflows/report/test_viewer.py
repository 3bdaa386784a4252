"""RUN/viewer.html: made where there is an asset, made again when that changes, and no hindrance where anything is wrong."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from efficientnerf.asset.format import save
from efficientnerf.geometry.cameras import rays
from pipeline.run import Run
from stages.formats.exporters import SPLAT_EXPORTERS
from stages.formats.exporters.writing import CAPTURE_IS_Z_UP
from stages.io import scene as scenes
from stages.io.pictures import opened
from stages.io.png import write_png
from stages.viewer.captured import PHOTOGRAPHS, SIDE, captured_views, photograph
from tests.efficientnerf.trees import random_tree
from tests.stages.balls import poses
from tests.stages.formats.gaussians import scattered
from tests.workflows.report.records import record, record_splats
from workflows.report.viewer import write_run_viewer


@pytest.fixture
def run(tmp_path: Path) -> Run:
    found = Run.create(tmp_path / "run")
    (found.path / "bake").mkdir()
    save(random_tree(3), found.path / "bake/asset.nerftree", "compact")
    poses(found.path / "poses")
    return found


def test_a_run_gets_a_page_with_its_cameras_and_photographs(run: Run) -> None:
    path = write_run_viewer(run)
    assert path == run.path / "viewer.html"
    text = path.read_text(encoding="utf-8")
    assert text.count("data:image/webp;base64,") == 8
    assert "<title>run</title>" in text
    (run.path / "poses/scene.json").write_text("{")
    path = write_run_viewer(run, anew=True)
    assert path is not None
    assert "data:image/webp" not in path.read_text(encoding="utf-8"), "without cameras, too"


def test_photographs_are_few_and_small_and_as_a_pinhole_takes_them(tmp_path: Path) -> None:
    folder = poses(tmp_path / "poses", count=PHOTOGRAPHS + 9)
    cameras, photographs = captured_views(folder, tmp_path / "train")
    assert (len(cameras), len(photographs)) == (PHOTOGRAPHS + 9, PHOTOGRAPHS)
    assert {camera.model for camera in cameras} == {"PINHOLE"}
    # A grid of lines through the distortion of its camera: straight again.
    scene = scenes.load(folder)
    view = scene.views[0]
    side = 2 * SIDE
    camera = replace(view.camera, width=side, height=side, model="SIMPLE_RADIAL", params=(float(side), side / 2, side / 2, 0.2))
    directions = rays(camera)[1] @ camera.world_from_camera[:3, :3]
    x = (directions[:, 0] / directions[:, 2]).reshape(side, side)
    write_png(np.repeat((128 + 127 * np.sin(30 * x)).astype(np.uint8)[..., None], 3, axis=2), folder / view.image)
    (tmp_path / "small.jpg").write_bytes(photograph(folder, replace(view, camera=camera), (1, 1, 1)))
    with opened(tmp_path / "small.jpg") as image:
        found = np.asarray(image.convert("L"), np.float64)
    assert found.shape == (SIDE, SIDE)
    expected = 128 + 127 * np.sin(30 * ((np.arange(SIDE) + 0.5) / SIDE - 0.5))
    inner = slice(SIDE // 8, -SIDE // 8)
    assert np.abs(found[inner, inner] - expected[inner]).mean() < 5


def test_the_page_shows_gaussians_where_there_are_any_or_what_was_asked_for(run: Run) -> None:
    def written(viewer: str | None) -> dict[str, bool]:
        """The pages, and whether each is of Gaussians."""
        if viewer is not None:
            run.update(viewer=viewer)
        write_run_viewer(run)
        return {page.name: '"splats":{' in page.read_text(encoding="utf-8") for page in sorted(run.path.glob("viewer*.html"))}

    assert written(None) == {"viewer.html": False}
    (run.path / "splats").mkdir()
    SPLAT_EXPORTERS[".spz"](scattered(), run.path / "splats/splats.spz", CAPTURE_IS_Z_UP)
    assert written(None) == {"viewer.html": False}, "nobody says of what these are"
    record_splats(run.path)
    assert written(None) == {"viewer.html": True}
    assert written("asset") == {"viewer.html": False}
    assert written("both") == {"viewer.html": True, "viewer_asset.html": False}
    assert written("off") == {}
    assert Run.open(run.path).viewer == "off"
    assert written("splats") == {"viewer.html": True}
    record(run.path, "bake", sha256="1" * 64)
    assert written(None) == {"viewer.html": False}, "of another asset"
    record_splats(run.path)
    assert written(None) == {"viewer.html": True}
    whole = (run.path / "splats/splats.spz").read_bytes()
    for damaged in (b"damaged", whole[: len(whole) // 2]):
        (run.path / "splats/splats.spz").write_bytes(damaged)
        os.utime(run.path / "splats")
        assert written(None) == {}
    run.update(viewer="asset")
    assert written(None) == {"viewer.html": False}, "the asset is sound"
    (run.path / "bake/asset.nerftree").write_bytes(b"damaged")
    os.utime(run.path / "bake")
    assert written(None) == {}
