"""Masked parts give no features."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stages.sfm import matches
from stages.sfm.colmap import quiet_pycolmap
from stages.sfm.database import database_path, open_database
from stages.sfm.images import prepare_images

STILL_LIFE = Path(__file__).resolve().parents[3] / "examples" / "still_life"


def test_masked_parts_give_no_features(tmp_path: Path) -> None:
    names = sorted(path.name for path in STILL_LIFE.glob("*.jpg"))[:3]
    if not names:
        pytest.skip("examples/still_life is not there")
    mask = np.zeros((360, 480), np.uint8)
    mask[:, 240:] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    quiet = {"progress": lambda *a, **k: None, "safe_point": lambda: None}
    paths = {name: STILL_LIFE / name for name in names}
    images, _ = prepare_images(paths, max_side=240, features=500, seed=0, masks={names[1]: tmp_path / "mask.png"}, work=tmp_path / "w", warn=print, **quiet)
    open_database(tmp_path / "w", images, print)
    matches.extract_features(tmp_path / "w", images, features=500, **quiet)
    with quiet_pycolmap() as pycolmap, pycolmap.Database.open(database_path(tmp_path / "w")) as database:
        columns = [database.read_keypoints(i)[:, 0] for i in (1, 2, 3)]
    assert columns[0].min() < 100
    assert len(columns[1]) > 10
    assert columns[1].min() >= 119
