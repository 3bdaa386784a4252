"""A subject that turns before a camera on a stand: told from a camera that moves, masked, and its cameras found by it alone."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from efficientnerf.geometry.cameras import Camera
from stages.io.png import write_png
from stages.io.reader import PhotoReader
from stages.masking.photographs import mask_choice
from stages.masking.turning import border_stands_still, masks_of_turning_subject
from stages.poses.run import read
from stages.verdict.verdict import verdict_on
from tests.stages import captures, turntables
from tests.stages.sfm.still_life import errors_of

COUNT = 11


def written(folder: Path, pictures: list[np.ndarray]) -> dict[str, Path]:
    folder.mkdir()
    for number, picture in enumerate(pictures):
        write_png(picture, folder / f"{number:02d}.png")
    return {path.name: path for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def turntable(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Camera]]:
    cameras = turntables.cameras(COUNT, 100.0)
    folder = tmp_path_factory.mktemp("turntable") / "photographs"
    written(folder, [turntables.picture(camera, number) for number, camera in enumerate(cameras)])
    return folder, cameras


def found_in(paths: dict[str, Path], work: Path) -> dict[str, Path]:
    return masks_of_turning_subject(paths, work, PhotoReader(work / "photographs"), safe_point=lambda: None, progress=lambda *_: None)


def test_a_subject_before_a_standing_wall_is_found_by_itself(turntable: tuple[Path, list[Camera]], tmp_path: Path) -> None:
    folder, cameras = turntable
    events: list[dict[str, Any]] = []
    job = captures.poses_job(folder, tmp_path, events.append)
    capture = read(job, job.settings, PhotoReader(tmp_path / "photographs"), job.warn)
    assert capture.provenance.background == "left out"
    assert any("the background stands still" in event.get("text", "") for event in events)
    assert mask_choice(job.settings, capture.provenance) == "silhouette"
    assert len(capture.photos) >= 0.9 * COUNT
    assert all(photo.mask is not None for photo in capture.photos)
    errors = errors_of(capture, {f"{number:02d}.png": camera.centre for number, camera in enumerate(cameras)})
    assert np.sqrt((errors**2).mean()) < 0.02
    problems = {problem.what: problem for problem in verdict_on(capture, {}).problems}
    assert problems["background"].grade == "good"
    assert "left out" in problems["background"].sentence


def test_nothing_is_left_out_where_nothing_moves_or_all_inside_a_frame_does(tmp_path: Path) -> None:
    camera = turntables.cameras(1)[0]
    same = written(tmp_path / "same", [turntables.picture(camera, number) for number in range(9)])
    assert border_stands_still(same, PhotoReader(tmp_path / "photographs"), lambda: None)
    assert not found_in(same, tmp_path / "same masks")
    rng = np.random.default_rng(0)
    frame = turntables.wall_picture()
    framed = []
    for _ in range(9):
        framed.append(frame.astype(np.uint8))
        framed[-1][20:-20, 20:-20] = rng.integers(0, 255, (200, 280, 3))
    assert not found_in(written(tmp_path / "framed", framed), tmp_path / "framed masks")
