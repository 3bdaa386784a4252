"""`enerf check`."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.stages import clips
from tests.workflows.command import Enerf
from workflows.asset import STAGES


def noise(folder: Path, count: int) -> Path:
    folder.mkdir()
    for k in range(count):
        Image.fromarray(np.random.default_rng(k).integers(0, 255, (48, 64, 3), np.uint8)).save(folder / f"{k}.png")
    return folder


def test_check_names_problems_and_exits_with_2_where_it_is_hopeless(enerf: Enerf, tmp_path: Path) -> None:
    folder = noise(tmp_path / "photos", 4)
    told = enerf("check", folder, "--json", "--memory", "1m").object
    assert (told["ok"], told["grade"], told["exit_code"]) == (False, "failed", 2)
    assert {"overlap", "few", "tiny", "noise"} <= {problem["what"] for problem in told["problems"]}
    forecast = told["forecast"]
    assert forecast["fits"] is False
    assert list(forecast["stage_seconds"]) == [stage.name for stage in STAGES]
    assert forecast["run_seconds"] == pytest.approx(sum(forecast["stage_seconds"].values()), abs=0.1)
    assert forecast["run_bytes"] > forecast["poses_bytes"]
    assert sorted(told["images"]) == ["0.png", "1.png", "2.png", "3.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photos"]  # nothing is written
    unmeasured = enerf("check", folder, "--set", "train.field=nerf", "--json")
    assert (unmeasured.code, unmeasured.object["forecast"]["run_seconds"]) == (2, None)
    text = enerf("check", folder, "--set", "train.field=nerf")
    assert text.code == 2
    assert all(words in text.err + text.out for words in (str(folder), "failed", "64x48", "without cameras"))


def test_check_says_what_is_left_aside(enerf: Enerf, tmp_path: Path) -> None:
    folder = noise(tmp_path / "photos", 4)
    noise(folder / "more", 2)
    (left,) = enerf("check", folder, "--json").object["left_aside"]
    assert "more" in str(left)
    assert enerf("check", folder / "more", "--json").object["left_aside"] == []
    (tmp_path / "empty").mkdir()
    for arguments, named in (([tmp_path / "none"], "none"), ([folder, "--set", "poses.nonsense=1"], "poses.nonsense"), ([tmp_path / "empty"], "empty")):
        refused = enerf("check", *arguments)
        assert (refused.code, named in refused.err) == (2, True)


def test_check_looks_at_the_frames_that_a_run_would_choose_of_a_video(enerf: Enerf, tmp_path: Path) -> None:
    clip = clips.write_clip(tmp_path / "clip.mp4", clips.pan(12, 6.0))
    told = enerf("check", clip, "--json", "--set", "poses.frames=5").object
    assert (told["source"], told["format"], told["photographs"], told["sizes"]) == (str(clip), "photographs", 5, ["96x64"])
    assert [path.name for path in tmp_path.iterdir()] == ["clip.mp4"]  # nothing is left
    still = enerf("check", clips.write_clip(tmp_path / "still.mp4", clips.pan(1, 0.0) * 12))
    assert (still.code, "the camera stands still" in still.out) == (2, True)
    (tmp_path / "clip.mp4").write_bytes(b"no video")
    assert "clip.mp4: unreadable" in enerf("check", clip).err
