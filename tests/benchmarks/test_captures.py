"""Pictures of whole captures, from the strips that their runs drew."""

from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.captures import write_picture
from stages.artifacts import EvaluateOutputs
from stages.figures.plots import LABEL_HEIGHT, MARGIN


def test_a_picture_shows_photograph_asset_and_mesh_of_the_median_view(tmp_path: Path) -> None:
    assert not write_picture(tmp_path, tmp_path / "out" / "none.webp")
    strip = np.full((40 + 2 * MARGIN + LABEL_HEIGHT, 4 * (60 + MARGIN) + MARGIN, 3), 255, np.uint8)
    greys = 40, 90, 140, 200
    for panel, grey in enumerate(greys):
        left = MARGIN + panel * (60 + MARGIN)
        strip[MARGIN : MARGIN + 40, left : left + 60] = grey
    path = EvaluateOutputs.of_run(tmp_path).strip_median
    path.parent.mkdir(parents=True)
    Image.fromarray(strip).save(path)
    assert write_picture(tmp_path, tmp_path / "out" / "a.webp")
    with Image.open(tmp_path / "out" / "a.webp") as picture:
        assert picture.size == (3 * 60 + 2 * 4, 40)
        found = np.asarray(picture)[20, [30, 94, 158], 0].astype(int)
    np.testing.assert_allclose(found, [greys[0], greys[2], greys[3]], atol=6)
