"""The sheet of markers has its true size on paper, and its markers are found in it."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from stages.figures.board import DPI, PAPERS, draw_board, write_board


@pytest.mark.parametrize("paper", [*PAPERS])
def test_markers_have_their_size_and_are_found(paper: str) -> None:
    picture = np.asarray(draw_board(paper, 50.0).convert("L"))
    np.testing.assert_allclose(picture.shape[::-1], np.array(PAPERS[paper]) * DPI / 25.4, atol=1)
    small = cv2.resize(picture, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    corners, numbers, _ = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)).detectMarkers(small)
    assert sorted(numbers.ravel()) == [*range(len(numbers))]
    assert len(numbers) >= 9
    edges = [np.linalg.norm(each[0] - np.roll(each[0], 1, axis=0), axis=1).mean() * 25.4 / (DPI / 4) for each in corners]
    np.testing.assert_allclose(edges, 50.0, rtol=0.005)


def test_files_state_the_size_and_repeat(tmp_path: Path) -> None:
    for name in ("a.pdf", "b.pdf", "a.png"):
        write_board(tmp_path / name, "a4", 60.0)
    written = (tmp_path / "a.pdf").read_bytes()
    assert written == (tmp_path / "b.pdf").read_bytes()
    box = re.search(rb"/MediaBox \[ ?([\d. ]+)\]", written)
    assert box is not None
    np.testing.assert_allclose([float(part) for part in box[1].split()], [0, 0, 210 * 72 / 25.4, 297 * 72 / 25.4], atol=0.2)
    with Image.open(tmp_path / "a.png") as image:
        np.testing.assert_allclose(image.info["dpi"], DPI, rtol=1e-3)
