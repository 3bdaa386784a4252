"""benchmarks/scenes/captures and benchmarks/made_captures: captures that no rule was made on, and that nothing of their subjects is masked before training."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import made_captures
from benchmarks.scenes import captures
from efficientnerf.geometry.cameras import project
from stages.formats import importers

WIDTH = 120
KINDS = captures.captures()


@pytest.mark.parametrize("kind", KINDS)
def test_no_subject_is_masked_before_training(kind: str, tmp_path: Path) -> None:
    row = made_captures.measured(kind, KINDS[kind], tmp_path, WIDTH, 48, seed=0)
    assert row["masked"] <= made_captures.MOST_MASKED
    assert 0 < row["near"][2] < row["distance"]  # no near plane behind the subject
    assert row["size"] > 0.15  # of the box, which is 2: it is not lost in a landscape


def test_a_mask_over_everything_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(made_captures, "masked_voxels", lambda found, poses, side: (np.ones((side,) * 3, bool), ()))
    assert made_captures.measured("arc", KINDS["arc"], tmp_path, WIDTH, 16, seed=0)["masked"] == 1
    assert made_captures.main(["--work", str(tmp_path), "--kinds", "arc", "--width", "120", "--side", "16", "--out", str(tmp_path / "out")]) == 1


@pytest.mark.parametrize("kind", ["gamepad", "corridor"])
def test_points_lie_in_view_of_what_found_them(kind: str) -> None:
    capture = KINDS[kind]
    xyz, error, tracks = captures.sparse_points(capture, WIDTH)
    views = captures.cameras(capture, WIDTH)
    assert min(len(track) for track in tracks) >= 2
    usual = np.flatnonzero(error <= 1.0)
    assert 0.9 < len(usual) / len(xyz) < 1  # the others are outliers
    off = []
    for point in usual[:: max(1, len(usual) // 50)]:
        pixels = [project(views[view], xyz[point : point + 1])[0][0] for view in tracks[point]]
        off.append(np.max([np.abs(2 * pixel / (WIDTH, 0.75 * WIDTH) - 1).max() for pixel in pixels]))
    assert np.quantile(off, 0.95) < 1.05


def test_the_same_arguments_give_the_same_files_that_are_read(tmp_path: Path) -> None:
    for name in ("one", "two"):
        captures.main([str(tmp_path / name), "--kinds", "strays", "--width", "32"])
    one, two = ({path.name: path.read_bytes() for path in (tmp_path / name).rglob("*.*")} for name in ("one", "two"))
    assert one == two
    folder = tmp_path / "one/strays"
    assert importers.detect(folder, False, "auto") == "colmap"
    assert importers.detect(folder / "images", False, "auto") == "photographs"
    true, stated = captures.cameras(KINDS["strays"], 32), captures.stated_cameras(KINDS["strays"], 32)
    moved = [n for n, (a, b) in enumerate(zip(true, stated, strict=True)) if not np.array_equal(a.centre, b.centre)]
    assert moved == list(KINDS["strays"].wrong)
