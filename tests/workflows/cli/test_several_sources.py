"""`enerf run` with several folders and videos."""

import json
from pathlib import Path

import pytest

from tests.stages import captures, clips
from tests.workflows.command import Enerf


@pytest.fixture
def sources(tmp_path: Path) -> list[Path]:
    captures.write_pictures(tmp_path / "photos", ["1.png", "2.png", "3.png"])
    return [clips.write_clip(tmp_path / "clip.mp4", clips.pan(4)), tmp_path / "photos"]


def test_all_are_taken_and_recorded(enerf: Enerf, sources: list[Path], tmp_path: Path) -> None:
    result = enerf("run", *sources, "--out", tmp_path / "run", "--until", "poses", "--dry-run", "--frames", "20")
    assert result.code == 0
    for refused in (["run", *sources, tmp_path / "photos" / ".." / "photos"], ["run", sources[1], "--frames", "1", "--dry-run"]):
        assert enerf(*refused, "--out", tmp_path / "run").code == 2
    posed = captures.nerfstudio(tmp_path / "posed")
    assert enerf("run", sources[1], posed, "--out", tmp_path / "run", "--until", "poses").code == 2, "photographs and videos alone"
    about = json.loads((tmp_path / "run" / "run.json").read_text())
    assert (about["source"], about["also"]) == (str(sources[1]), [str(posed)])


def test_networks_that_match_are_given_as_two_files(enerf: Enerf, sources: list[Path], tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("detector.onnx", "matcher.onnx")]
    result = enerf("run", sources[1], "--out", tmp_path / "run", "--until", "poses", "--features-model", *files)
    assert (result.code, str(files[0]) in result.err) == (2, True), "there are no such files"
    settings = json.loads((tmp_path / "run" / "run.json").read_text())["settings"]["poses"]
    assert [settings[name] for name in ("features_model", "matcher_model")] == [str(file) for file in files]
    assert enerf("run", sources[1], "--out", tmp_path / "other", "--set", f"poses.matcher_model={files[1]}", "--until", "poses").code == 2
    assert enerf("run", sources[1], "--out", tmp_path / "other", "--features-model", files[0]).code == 2
