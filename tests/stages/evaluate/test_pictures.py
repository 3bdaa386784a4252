"""Strips at full size and the video of the captured path: what they show, what they cost, the same after a stop."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.stage import Job
from stages.io.scene import load
from tests.fakes import WHITE, BallField
from tests.stages.evaluate.balls import TREE, job_in, make_scene, measure, settings
from tests.stages.spoilers import SPOILERS


def test_the_captured_path_is_a_video_of_the_asset(tmp_path: Path) -> None:
    import av

    job = job_in(tmp_path, make_scene(tmp_path / "poses", "rrtr"), settings(captured_path_frames=7))
    measure(TREE, lambda: BallField(TREE, background=WHITE), job)
    with av.open(str(job.out / "captured_path.mp4")) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    assert len(frames) == 7
    assert frames[0].shape == (352, 480, 3)
    first = TREE.render(replace(load(tmp_path / "poses").views[0].camera, width=480, height=352, params=(560.0, 240.0, 176.0)), background=WHITE).colour
    assert np.abs(frames[0] / 255.0 - first).mean() < 0.02, "it begins at the first photograph"
    assert sorted(path.name for path in job.out.iterdir()) == ["captured_path.mp4", "contact_sheet.png", "metrics.json", "verdict.json"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Job]:
    """Poses and a job that has been done, with its work folder."""
    folder = tmp_path_factory.mktemp("whole")
    poses = make_scene(folder / "poses", "tt")
    job = job_in(folder, poses, settings(strips="on", captured_path_frames=2))
    measure(TREE, lambda: BallField(TREE, background=WHITE), job)
    return poses, job


@pytest.mark.parametrize(("pattern", "how"), [("strip_*", "cut"), ("strip_*", "link"), ("captured/frame_*", "zero")])
def test_damaged_strips_and_frames_are_made_again(whole: tuple[Path, Job], tmp_path: Path, how: str, pattern: str) -> None:
    poses, undisturbed = whole
    shutil.copytree(undisturbed.work, tmp_path / "work")
    for path in sorted(undisturbed.work.glob(pattern)):
        SPOILERS[how](tmp_path / "work" / path.relative_to(undisturbed.work))
    job = job_in(tmp_path, poses, undisturbed.settings)
    measure(TREE, lambda: BallField(TREE, background=WHITE), job)
    names = [path.name for path in sorted(undisturbed.out.iterdir())]
    assert len(names) == 6
    for name in names:
        assert (job.out / name).read_bytes() == (undisturbed.out / name).read_bytes()
