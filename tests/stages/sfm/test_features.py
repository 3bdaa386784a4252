"""Masked parts give no features."""

from pathlib import Path

import numpy as np
from PIL import Image

from stages.sfm import matches
from stages.sfm.colmap import quiet_pycolmap
from stages.sfm.database import database_path, open_database
from stages.sfm.images import prepare_images
from tests.stages.sfm.still_life import QUIET, STILL_LIFE, neighbours


def test_masked_parts_give_no_features(tmp_path: Path) -> None:
    names = neighbours(3)
    mask = np.zeros((360, 480), np.uint8)
    mask[:, 240:] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    paths = {name: STILL_LIFE / name for name in names}
    images, _ = prepare_images(paths, max_side=240, features=500, seed=0, masks={names[1]: tmp_path / "mask.png"}, work=tmp_path / "w", warn=print, **QUIET)
    open_database(tmp_path / "w", images, print)
    matches.extract_features(tmp_path / "w", images, features=500, **QUIET)
    with quiet_pycolmap() as pycolmap, pycolmap.Database.open(database_path(tmp_path / "w")) as database:
        columns = [database.read_keypoints(i)[:, 0] for i in (1, 2, 3)]
    assert columns[0].min() < 100
    assert len(columns[1]) > 10
    assert columns[1].min() >= 119
