"""3D Scanner App's "All Data": what is particular to it; `test_exported_cameras` has what every importer does."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.geometry.cameras import project
from pipeline.errors import BadInput
from stages.formats import importers
from stages.io.capture import Capture
from tests.stages import captures, exports
from tests.stages.captures import Settings

NAME = "3d-scanner-app"


def read(folder: Path) -> Capture:
    return importers.IMPORTERS[NAME].read(folder, Settings())


def changed(folder: Path, change: Callable[[dict[str, Any]], Any], every: bool = False) -> Path:
    """The export with its third frame, or every one, changed."""
    folder, _ = exports.scanner_app(folder)
    for path in sorted(folder.glob("frame_*.json")) if every else [folder / "frame_00002.json"]:
        document = json.loads(path.read_text())
        change(document)
        path.write_text(json.dumps(document))
    return folder


def test_frame_up_and_what_has_no_partner(tmp_path: Path) -> None:
    folder, _ = exports.scanner_app(tmp_path / "a")
    (folder / "frame_00004.json").unlink()
    capture = read(folder)
    assert [photo.image.name for photo in capture.photos] == [f"frame_0000{index}.jpg" for index in (0, 1, 2, 3, 5)]
    assert capture.metric
    assert capture.up.tolist() == [0, 1, 0]
    assert capture.facts["poses_without_picture"] == 2
    assert capture.rejected == (("frame_00004.jpg", "without a pose"),)
    assert any("1 images are left out, without a pose: frame_00004.jpg" in warning for warning in capture.warnings)
    assert folder / "frame_00006.json" not in importers.files(folder, Settings()), "it has no picture"


@pytest.mark.parametrize("size", [(64, 48), (24, 32)])
def test_pictures_that_the_lens_is_not_of_are_refused(size: tuple[int, int], tmp_path: Path) -> None:
    folder, _ = exports.scanner_app(tmp_path / "a")
    captures.write_picture(folder / "frame_00001.jpg", captures.picture(0, *size))
    with pytest.raises(BadInput, match=r"frame_00001\.json"):
        read(folder)


MATRIX = np.eye(4).ravel().tolist()


def test_values_that_cannot_be_are_refused(tmp_path: Path) -> None:
    poses = [None, MATRIX[:12], ["a", *MATRIX[1:]], [*MATRIX[:12], 1, 2, 3, 1], [0.0] * 15 + [1], [-1, *MATRIX[1:]]]
    lenses = [[40, 0, 0, 0, 41, 0, 16, 12, 1], [40, 3, 16, 0, 41, 12, 0, 0, 1], [-40, 0, 16, 0, 41, 12, 0, 0, 1], [1e300, 0, 16, 0, 41, 12, 0, 0, 1]]
    values = [{"cameraPoseARFrame": each} for each in poses] + [{"intrinsics": each} for each in (None, {"fx": 40}, *lenses)]
    for index, each in enumerate(values):
        folder = changed(tmp_path / str(index), lambda document, each=each: document.update(each))
        with pytest.raises(BadInput, match=r"frame_00002\.json"):
            read(folder)
    (folder / "frame_00000.json").write_text('{"cameraPoseARFrame": [1, 0')
    assert importers.candidates(folder)[0] == NAME, "no other format is chosen"
    with pytest.raises(BadInput, match=r"frame_00000\.json"):
        read(folder)


def test_depth_where_the_sensor_is_sure(tmp_path: Path) -> None:
    folder, _ = exports.scanner_app(tmp_path / "a")
    for photo in read(folder).photos:
        number = photo.image.stem.removeprefix("frame_")
        exports.write_depth(folder / f"depth_{number}.png", exports.plane_depth(photo.camera, 64, 48))
        sure = np.ones((48, 64), np.uint8)  # medium
        sure[12:36, 16:48] = 2
        captures.write_picture(folder / f"conf_{number}.png", sure)
    capture = read(folder)
    assert np.abs(capture.points.xyz[:, 2]).max() < 0.01, "they lie on the plane"
    for index, photo in enumerate(capture.photos):
        seen = [point for point, track in zip(capture.points.xyz, capture.points.tracks, strict=True) if index in track]
        assert (np.abs(project(photo.camera, np.array(seen))[0] - (16, 12)) < (8.1, 6.1)).all(), "in the middle, where the maps are sure"
    assert {folder / "depth_00003.png", folder / "conf_00003.png"} < set(importers.files(folder, Settings()))
