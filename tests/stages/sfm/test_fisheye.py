"""Cameras of photographs that a fisheye lens took: half of all directions in one picture."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.scenes import room as rooms
from efficientnerf.geometry.cameras import Camera, rays
from stages.sfm.cameras import find_cameras
from stages.sfm.reconstruction import Request
from tests.stages.sfm.still_life import SILENT, errors_of

WIDTH, HEIGHT = 400, 300
LENS = (132.0, 132.4, 200.0, 150.0, 0.03, -0.008, 0.002, -0.0005)  # 174 degrees from left to right
NAME = "AF Fisheye 8mm F2.8"


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Camera]]:
    made = rooms.cameras(10, WIDTH, HEIGHT, "OPENCV_FISHEYE", LENS)
    return rooms.write(tmp_path_factory.mktemp("room"), made, NAME), made


def test_cameras_and_lens_are_those_that_took_the_photographs(room: tuple[Path, list[Camera]], tmp_path: Path) -> None:
    folder, made = room
    found = find_cameras(Request(folder, {camera.name: folder / camera.name for camera in made}, tmp_path), **SILENT)
    assert [photo.camera.name for photo in found.photos] == [camera.name for camera in made]
    assert {photo.camera.model for photo in found.photos} == {"OPENCV_FISHEYE"}
    assert not found.warnings
    errors = errors_of(found, {camera.name: camera.centre for camera in made})
    assert np.sqrt((errors**2).mean()) < 0.001
    # The directions of pixels from their camera, out to the corners.
    pixels = np.array([[x, y] for x in (5.0, 100.0, 200.0, 395.0) for y in (5.0, 150.0, 295.0)])
    one, other = (rays(camera, pixels)[1] @ camera.world_from_camera[:3, :3] for camera in (found.photos[0].camera, made[0]))
    assert np.degrees(np.arccos(np.clip((one * other).sum(1), -1, 1))).max() < 0.5
