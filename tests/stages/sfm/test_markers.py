"""Corners of markers as tie points of structure from motion."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from efficientnerf.geometry.cameras import project
from pipeline.errors import BadInput
from stages.io.png import write_png
from stages.sfm.added.markers import GRID, keep_markers, tie_markers
from stages.sfm.cameras import find_cameras
from stages.sfm.colmap import quiet_pycolmap
from stages.sfm.database import database_path, inlier_counts, mapper_database
from stages.sfm.reconstruction import Request
from tests.stages.sfm.made_matches import POINTS, cameras, matched
from tests.stages.sfm.still_life import SILENT

EDGE = 0.12


def test_markers_reach_the_process_that_ties_them(tmp_path: Path) -> None:
    """Which refuses grey photographs, and not what it was asked."""
    paths = {f"{k}.png": tmp_path / f"{k}.png" for k in range(3)}
    for path in paths.values():
        write_png(np.full((90, 120, 3), 128, np.uint8), path)
    request = Request(tmp_path, paths, tmp_path / "work", markers={"0.png": {7: np.array([[10.0, 10], [30, 10], [30, 30], [10, 30]])}})
    with pytest.raises(BadInput, match="cameras found for 0 of 3"):
        find_cameras(request, **SILENT)
    noted = json.loads((tmp_path / "work/markers.json").read_bytes())
    np.testing.assert_allclose(noted["00000.png"]["7"][4], [20, 20])


def test_markers_tie_photographs_that_see_them_and_without_any_nothing_changes(tmp_path: Path) -> None:
    """One that moves from photograph to photograph is none of the verified matches, and one that a mask leaves out none at all."""
    taken = cameras()
    images = matched(tmp_path, taken)
    keep_markers(tmp_path, images, {})
    tie_markers(tmp_path, 0, lambda: None)
    assert mapper_database(tmp_path) == database_path(tmp_path)
    square, markers = EDGE / 2 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]), {}
    for k, camera in enumerate(taken[:4]):
        places = {0: (-0.2, -0.2, 0.0), 1: (0.2, 0.1, 0.1), 2: (0.1, 0.1, (0.0, 0.3, -0.3, 0.15)[k]), 3: (0.0, 0.2, 0.2)}
        markers[camera.name] = {number: project(camera, square + place)[0] for number, place in places.items()}
    mask = np.full((images[0].work_height, images[0].work_width), 255, np.uint8)
    x, y = markers["0.png"][3].mean(0).astype(int)
    mask[y - 9 : y + 9, x - 9 : x + 9] = 0
    (tmp_path / "masks").mkdir()
    write_png(mask, tmp_path / "masks" / f"{images[0].file}.png")
    keep_markers(tmp_path, images, markers)
    tie_markers(tmp_path, 0, lambda: None)
    with quiet_pycolmap() as pycolmap, pycolmap.Database.open(mapper_database(tmp_path)) as database:
        tied = {}
        for pair in inlier_counts(database_path(tmp_path)):
            matches = np.asarray(database.read_two_view_geometry(*pair).inlier_matches).astype(int) - POINTS
            tied[pair] = sorted({int(a) // GRID**2 for a, b in matches if a >= 0 and b >= 0})
    assert {pair: numbers for pair, numbers in tied.items() if max(pair) <= 4} == {
        (i, j): [0, 1] if i == 1 else [0, 1, 3] for i in range(1, 5) for j in range(i + 1, 5)
    }
    assert not any(numbers for pair, numbers in tied.items() if max(pair) > 4)
