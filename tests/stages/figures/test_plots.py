"""Contact sheets and curves: right places, right sizes, the same bytes twice."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from stages.figures.plots import LABEL_HEIGHT, MARGIN, contact_sheet


def test_sheet_holds_each_image_at_its_place(tmp_path: Path) -> None:
    red, green = np.zeros((10, 20, 3), np.uint8), np.zeros((20, 20, 4), np.float32)
    red[..., 0] = 255
    green[..., 1:4:2] = 1.0
    contact_sheet([[red, None], [green, red]], [["red", ""], ["a very long name of a green image.png", "red"]], tmp_path / "sheet.png", thumbnail=60)
    with Image.open(tmp_path / "sheet.png") as sheet:
        pixels = np.asarray(sheet)
    assert pixels.shape == (MARGIN + 30 + 60 + 2 * (LABEL_HEIGHT + MARGIN), MARGIN + 2 * (60 + MARGIN), 3)
    assert tuple(pixels[MARGIN + 15, MARGIN + 30]) == (255, 0, 0)
    assert tuple(pixels[MARGIN + 15, 2 * MARGIN + 60 + 30]) == (255, 255, 255)
    second = MARGIN + 30 + LABEL_HEIGHT + MARGIN
    assert tuple(pixels[second + 30, MARGIN + 30]) == (0, 255, 0)
    assert (pixels[second + 60 : second + 60 + LABEL_HEIGHT, MARGIN : MARGIN + 60] < 128).any(), "the label is written"
    assert (pixels[:, 60 + MARGIN + 1 : 60 + 2 * MARGIN - 1] == 255).all(), "a long label stays in its column"
