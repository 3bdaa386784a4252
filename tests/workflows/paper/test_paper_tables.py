"""Tables that train: what a scale makes of the settings, what a log says of the pace, what the tables make of figures, and one table from end to end."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.paper import document as paper
from benchmarks.paper import tables
from benchmarks.paper.document import PAPER, Request
from benchmarks.paper.runs import Figures, Row, settings_of
from tests.efficientnerf.balls import cameras, picture
from tests.stages.captures import write_picture


def ball(folder: Path) -> Path:
    """A Blender data set of the analytic ball: 8 views to train on, 2 to test on."""
    for split, some in (("train", cameras(8, 48)), ("test", cameras(10, 48)[8:])):
        frames = []
        for n, camera in enumerate(some):
            write_picture(folder / split / f"{n}.png", picture(camera))
            pose = camera.world_from_camera.copy()
            pose[:3, 1:3] *= -1  # Blender's cameras look along -z
            frames.append({"file_path": f"./{split}/{n}", "transform_matrix": pose.tolist()})
        import math

        document = {"camera_angle_x": 2 * math.atan(24 / (1.3 * 48)), "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(document))
    return folder


def made_up(steady: float, psnr: float) -> Figures:
    tree = {"psnr": psnr - 0.5, "ssim": 0.9, "fps": 20.0, "frame": "100x100", "mib": 3.0}
    return Figures(psnr, 0.95, 2 * steady, steady, 1.0, 12.0, 24.0, 0.1, 0.04, ([1.0, 2.0], [20.0, psnr]), tree)


@pytest.mark.parametrize("number", ["1", "2", "3", "4", "5", "6"])
def test_every_table_can_be_made_of_figures(number: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def measured(request: Request, scene: Path, row: Row) -> Figures:
        settings_of(row, request.scale)  # its settings exist
        return made_up(0.184 if row.name == "nerf" else 0.021, 21.0 if row.name == "valid" else 30.0)

    monkeypatch.setattr(tables, "measured", measured)
    ball(tmp_path / "scenes" / "chair")
    paper.make(number, Request(tmp_path / "scenes", tmp_path / "out", 0.001))
    document = json.loads((tmp_path / "out" / f"table_{number}.json").read_text())
    assert any(column.endswith(PAPER) for column in document["columns"])
    assert all(set(row) <= set(document["columns"]) for row in document["rows"])
    assert (tmp_path / "out" / f"table_{number}.png").exists()
    if number == "5":
        assert document["rows"][0]["method"] == "NeRF"
        for column in ("less time %", "less time %" + PAPER):
            assert document["rows"][-1][column] == pytest.approx(88.6, abs=0.1)
        assert "valid on chair" in " ".join(document["notes"]), "what has not converged does not count"
    if number == "1":
        assert document["rows"][0]["valid %" + PAPER] == 9.58
