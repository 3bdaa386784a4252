"""A subject that turns before a camera on a stand: told from a camera that moves, masked, and its cameras found by it alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.poses import aligned_errors
from efficientnerf.geometry.cameras import Camera
from pipeline.errors import BadInput
from pipeline.stage import Job
from stages.io.capture import Capture, Photo, Provenance
from stages.io.png import write_png
from stages.io.reader import PhotoReader
from stages.masking.photographs import _of_turning_subject, mask_choice
from stages.masking.turning import border_stands_still, masks_of_turning_subject
from stages.poses.run import read
from stages.poses.settings import PosesSettings
from stages.verdict.verdict import verdict_on
from tests.stages import turntables

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
    job = Job(settings=PosesSettings(), out=tmp_path / "poses", work=tmp_path / "work", source=folder, stage="poses", report=events.append)
    capture = read(job, PosesSettings(), PhotoReader(tmp_path / "photographs"), job.warn)
    assert capture.provenance.background == "left out"
    assert any("the background stands still" in event.get("text", "") for event in events)
    assert mask_choice(job.settings, capture.provenance) == "silhouette"
    assert len(capture.photos) >= 0.9 * COUNT
    assert all(photo.mask is not None for photo in capture.photos)
    true = np.array([cameras[int(Path(photo.camera.name).stem)].centre for photo in capture.photos])
    errors = aligned_errors(np.array([photo.camera.centre for photo in capture.photos]), true)
    assert np.sqrt((errors**2).mean()) < 0.02
    problems = {problem.what: problem for problem in verdict_on(capture, {}).problems}
    assert problems["background"].grade == "good"
    assert "left out" in problems["background"].sentence


def test_what_moves_or_has_no_texture_is_no_standing_background(turntable: tuple[Path, list[Camera]], tmp_path: Path) -> None:
    cameras = turntables.cameras(10)
    moving = [turntables.picture(camera, number, wall_moves=True) for number, camera in enumerate(cameras)]
    plain = [turntables.picture(camera, number, wall=np.full((240, 320, 3), 200.0)) for number, camera in enumerate(cameras)]
    few = dict(list({path.name: path for path in sorted(turntable[0].iterdir())}.items())[:7])
    for name, paths in (("moving", written(tmp_path / "moving", moving)), ("plain", written(tmp_path / "plain", plain)), ("few", few)):
        assert not border_stands_still(paths, PhotoReader(tmp_path / "photographs"), lambda: None), name
        assert not found_in(paths, tmp_path / f"{name} masks"), name


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


@pytest.mark.parametrize(
    ("alone", "whole", "used"),
    [
        ((20, 0.9, 90.0), None, "cameras_of_subject"),  # all of the picture is not looked at
        ((10, 0.9, 90.0), (20, 0.97, 90.0), "cameras"),
        ((10, 0.9, 90.0), (20, 0.4, 90.0), "cameras_of_subject"),  # what stands still contradicts what turns
        ((10, 0.9, 90.0), (20, 0.97, 2.0), "cameras_of_subject"),  # what stands still is all that was found
        ((10, 0.9, 90.0), "nothing", "cameras_of_subject"),
    ],
)
def test_few_photographs_by_the_subject_alone_leave_no_others_out(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, alone: tuple[int, float, float], whole: Any, used: str
) -> None:
    """Photographs with a camera, share of the matches that agree, and the angle between the first and the last camera's view."""
    paths = {f"{n:02d}.png": tmp_path / f"{n:02d}.png" for n in range(20)}
    monkeypatch.setattr("stages.masking.photographs.masks_of_turning_subject", lambda *_, **__: paths)
    searched = []

    def find(name: str, masks: Mapping[str, Path | None]) -> Capture:
        searched.append(name)
        wanted = alone if name == "cameras_of_subject" else whole
        if wanted == "nothing":
            raise BadInput("no cameras")
        count, agreeing, degrees = wanted
        round_it = turntables.cameras(count, degrees * count / (count - 1))
        photos = tuple(Photo(camera, tmp_path / camera.name, masks.get(camera.name)) for camera in round_it)
        return Capture(kind="photographs", photos=photos, background=None, provenance=Provenance(pairs_agreeing=agreeing))

    job = Job(settings=PosesSettings(), out=tmp_path / "poses", work=tmp_path / "work", source=tmp_path, stage="poses")
    capture, seen = _of_turning_subject(job, find, paths, PhotoReader())
    assert not seen
    assert len(capture.photos) == (alone[0] if used == "cameras_of_subject" else whole[0])
    assert (capture.provenance.background == "left out") == (used == "cameras_of_subject")
    assert searched == (["cameras_of_subject"] if whole is None else ["cameras_of_subject", "cameras"])
