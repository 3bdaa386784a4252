"""`enerf check`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.stages import clips
from tests.workflows.command import Enerf


def noise(folder: Path, count: int) -> Path:
    folder.mkdir()
    for k in range(count):
        Image.fromarray(np.random.default_rng(k).integers(0, 255, (48, 64, 3), np.uint8)).save(folder / f"{k}.png")
    return folder


def test_check_says_what_is_wrong_and_exits_with_2_where_nothing_can_come_of_it(enerf: Enerf, tmp_path: Path) -> None:
    folder = noise(tmp_path / "photos", 4)
    text = enerf("check", folder)
    assert text.code == 2
    assert f"{folder}: failed; 4 photographs, 64x48, read as photographs" in text.err + text.out
    assert "overlap with no other" in text.out + text.err
    assert "6 pairs compared, up to " in text.out + text.err
    assert " where photographs match badly" in text.out + text.err
    assert "All stages of the preset preview: about " in text.out + text.err
    told = enerf("check", folder, "--json", "--memory", "1m").object
    assert (told["ok"], told["grade"], told["exit_code"]) == (False, "failed", 2)
    assert {"overlap", "few", "tiny", "noise"} <= {problem["what"] for problem in told["problems"]}
    assert told["forecast"]["fits"] is False
    assert list(told["forecast"]["stage_seconds"]) == ["poses", "train", "bake", "mesh", "splats", "evaluate", "turntable", "points"]
    assert told["forecast"]["run_seconds"] == pytest.approx(sum(told["forecast"]["stage_seconds"].values()), abs=0.1)
    assert told["forecast"]["run_bytes"] > told["forecast"]["poses_bytes"]
    assert sorted(told["images"]) == ["0.png", "1.png", "2.png", "3.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photos"]  # nothing is written


def test_check_forecasts_no_stages_that_were_never_measured(enerf: Enerf, tmp_path: Path) -> None:
    folder = noise(tmp_path / "photos", 4)
    assert "Then training, for as long as --budget says" in enerf("check", folder, "--set", "train.field=nerf").out
    assert enerf("check", folder, "--set", "train.field=nerf", "--json").object["forecast"]["run_seconds"] is None


def test_check_says_what_is_left_aside(enerf: Enerf, tmp_path: Path) -> None:
    folder = noise(tmp_path / "photos", 4)
    noise(folder / "more", 2)
    assert "2 more images in other folders (more) are not read" in enerf("check", folder).out
    assert len(enerf("check", folder, "--json").object["left_aside"]) == 1
    assert enerf("check", folder / "more", "--json").object["left_aside"] == []


def test_check_refuses_what_is_no_folder_of_photographs(enerf: Enerf, tmp_path: Path) -> None:
    assert enerf("check", tmp_path / "none").code == 2
    assert "no such folder" in enerf("check", tmp_path / "none").err
    assert enerf("check", noise(tmp_path / "photos", 3), "--set", "poses.nonsense=1").code == 2
    (tmp_path / "empty").mkdir()
    assert "empty" in enerf("check", tmp_path / "empty").err


def test_check_looks_at_the_frames_that_a_run_would_choose_of_a_video(enerf: Enerf, tmp_path: Path) -> None:
    clip = clips.write_clip(tmp_path / "clip.mp4", clips.pan(12, 6.0))
    told = enerf("check", clip, "--json", "--set", "poses.frames=5").object
    assert (told["source"], told["format"], told["photographs"], told["sizes"]) == (str(clip), "photographs", 5, ["96x64"])
    assert [path.name for path in tmp_path.iterdir()] == ["clip.mp4"]  # nothing is left
    (tmp_path / "clip.mp4").write_bytes(b"no video")
    assert "clip.mp4: unreadable" in enerf("check", clip).err
