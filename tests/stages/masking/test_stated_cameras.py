"""Photographs of a source that states cameras: those that are found come into its frame."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from efficientnerf.geometry.cameras import Similarity
from stages.formats import importers
from stages.io.capture import Capture
from stages.masking.photographs import _in_known_frame
from stages.poses.settings import PosesSettings
from tests.stages import captures

AWAY = Similarity(0.2, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([4.0, 1, -3]))
ANEW = PosesSettings(format="photographs")


def job_of(folder: Path, settings: PosesSettings = ANEW) -> Any:
    return SimpleNamespace(source=folder, sources={"": folder}, settings=settings)


def found_for(stated: Capture) -> Capture:
    """What structure from motion would find of the same photographs."""
    return replace(stated, kind="photographs", photos=tuple(replace(photo, camera=AWAY.camera(photo.camera)) for photo in stated.photos), points=None)


def test_cameras_come_into_the_frame_of_those_that_are_stated(tmp_path: Path) -> None:
    source = captures.colmap_txt(tmp_path / "source")
    stated = importers.IMPORTERS["colmap"].read(source, PosesSettings())
    files = {photo.camera.name: photo.image for photo in stated.photos}
    capture, said = _in_known_frame(job_of(source), found_for(stated), files)
    for photo, true in zip(capture.photos, stated.photos, strict=True):
        np.testing.assert_allclose(photo.camera.world_from_camera, true.camera.world_from_camera, atol=1e-6)
    assert capture.provenance.stated_cameras.used == "frame"
    assert len(said) == 1
    assert "6 of the 6 photographs (colmap)" in said[0]


def test_what_states_cameras_is_among_the_files_that_a_run_depends_on(tmp_path: Path) -> None:
    source = captures.colmap_txt(tmp_path / "source")
    plain = set(importers.IMPORTERS["photographs"].files(source, ANEW))
    with_cameras = set(importers.files(source, ANEW))
    assert {path.name for path in with_cameras - plain} == {"cameras.txt", "images.txt", "points3D.txt"}
    assert importers.posed_format(source, PosesSettings()) is None
    assert importers.posed_format(source / "images", ANEW) is None
    assert importers.posed_format(tmp_path / "nothing", ANEW) is None
    assert set(importers.files(source / "images", ANEW)) == {path for path in plain if path.parent.name == "images"}
