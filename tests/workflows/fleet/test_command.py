"""`enerf fleet` on toy scenes: whatever becomes of one scene, the others are done."""

import os
import shutil
import sys
from pathlib import Path

import pytest

from pipeline.fleet import requests
from tests.pipeline.toy import contents
from tests.workflows.command import Enerf
from tests.workflows.fleet.fleets import fleet_json, toy_manifest
from workflows.fleet.running import held


@pytest.fixture
def scenes(toys: Path, tmp_path: Path) -> Path:
    """A folder of four scenes' sources."""
    toy_manifest(tmp_path, 4)
    return tmp_path / "shoots"


def manifest(folder: Path, **fails: str) -> Path:
    return toy_manifest(folder.parent, 4, **fails)


def states(fleet: Path) -> dict[str, str]:
    return {scene["name"]: scene["state"] for scene in fleet_json(fleet)["scenes"]}


def test_the_scenes_of_a_folder_are_as_one_by_one(enerf: Enerf, scenes: Path, tmp_path: Path) -> None:
    """And the same command again does nothing, or what is stale after a change."""
    fleet = tmp_path / "fleet"
    command = ["fleet", scenes, "--out", fleet, "--preset", "tiny"]
    result = enerf(*command, "--jobs", 2)
    assert result.code == 0, result.err
    assert fleet_json(fleet)["totals"] == {"waiting": 0, "running": 0, "done": 4, "failed": 0, "quarantined": 0}
    assert (fleet / "index.html").is_file()
    assert (fleet / "fleet.csv").read_text(encoding="utf-8").count("done") == 4
    for number in (0, 3):
        alone = tmp_path / f"alone{number}"
        assert enerf("run", scenes / f"s{number}", "--out", alone, "--preset", "tiny", "--quiet").code == 0
        assert stages_of(fleet / f"s{number}") == stages_of(alone)
        assert (fleet / f"s{number}" / "report.html").is_file()
    before = {path: path.stat().st_mtime_ns for path in fleet.glob("*/*/manifest.json")}
    assert len(before) == 12
    again = enerf(*command, "--json")
    assert [each["event"] for each in again.objects] == ["scene_done"] * 4 + ["summary"]
    assert before == {path: path.stat().st_mtime_ns for path in fleet.glob("*/*/manifest.json")}
    (scenes / "s3" / "a.txt").write_text("another", encoding="utf-8")
    (fleet / "s2" / "points" / "points.ply").write_text("altered", encoding="utf-8")
    assert enerf(*command).code == 0
    made = {path.parent.relative_to(fleet).as_posix() for path, time in before.items() if path.stat().st_mtime_ns != time}
    assert made == {"s3/poses", "s3/train", "s3/points", "s2/points"}


def stages_of(run: Path) -> dict[str, bytes]:
    return {name: data for name, data in contents(run).items() if name.startswith(("poses/", "train/", "points/"))}


def test_bad_scenes_are_quarantined_with_their_reason_and_the_others_done(enerf: Enerf, scenes: Path, tmp_path: Path) -> None:
    fleet = tmp_path / "fleet"
    kinds = {"s1": "bad", "s2": "error", "s3": "disk"}  # a full disk is no fault of the scene
    result = enerf("fleet", manifest(scenes, **kinds), "--out", fleet, "--jobs", 2)
    assert result.code == 3, result.err
    assert states(fleet) == {"s0": "done", "s1": "quarantined", "s2": "quarantined", "s3": "failed"}
    for scene in fleet_json(fleet)["scenes"][1:]:
        assert scene["reason"]
        assert any(scene["last_lines"])
        assert scene["stages"]["train"]["state"] == "failed"
    assert f"enerf fleet retry {fleet}" in result.out
    told = enerf("fleet", "status", fleet)
    assert (told.code, "first line" in told.out) == (0, True)
    assert enerf("fleet", "status", fleet, "--json").object["totals"]["quarantined"] == 2
    again = enerf("fleet", manifest(scenes, **kinds), "--out", fleet, "--json")
    assert [(each["scene"], each["stage"]) for each in again.objects if each["event"] == "stage_started"] == [("s3", "train")]
    tried = enerf("fleet", "retry", fleet, "s2", "--json")
    assert tried.code == 3
    assert "s2" in {each.get("scene") for each in tried.objects if each["event"] == "stage_failed"} <= {"s2", "s3"}
    assert enerf("fleet", "retry", fleet, "nobody").code == 2
    # Once it is put right, a scene is another, and is run.
    assert enerf("fleet", manifest(scenes), "--out", fleet).code == 0
    assert set(states(fleet).values()) == {"done"}
    assert enerf("fleet", "status", tmp_path / "nowhere").code == 2


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits on addresses are Linux's")
def test_what_runs_out_of_memory_is_done_in_half_by_a_new_process(enerf: Enerf, scenes: Path, tmp_path: Path) -> None:
    """The limit is the system's, the MemoryError the allocator's; and where the system ends the process, the same is done."""
    fleet = tmp_path / "fleet"
    result = enerf("fleet", manifest(scenes, s0="greedy", s2="ended"), "--out", fleet, "--memory", "1g", "--json")
    assert result.code == 0, fleet_json(fleet)
    told = {each["scene"]: each["text"] for each in result.objects if each["event"] == "retry"}
    assert "1.0 GiB" in told["s0"]
    assert "SIGKILL" in told["s2"]
    started = [each["text"].split() for each in result.objects if each["event"] == "message" and (each["scene"], each["stage"]) == ("s0", "train")]
    assert [limit for limit, _ in started] == ["1073741824", "536870912"]
    assert started[0][1] != started[1][1], "another process"
    assert (fleet / "s0" / "points" / "points.ply").is_file()


def test_a_second_fleet_says_who_holds_it(enerf: Enerf, scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(requests, "ANSWER_SECONDS", 0.0)
    fleet = tmp_path / "fleet"
    command = ["fleet", scenes / "s1", scenes / "s2", "--out", fleet, "--preset", "tiny"]
    assert enerf(*command).code == 0
    with held(fleet):
        result = enerf(*command)
        assert (result.code, f"process {os.getpid()} on" in result.err) == (5, True)
        assert enerf("fleet", "cancel", fleet, "s1").code == 0
        assert len(list((fleet / ".requests").iterdir())) == 1
    assert enerf("fleet", "cancel", fleet).code == 2
    assert enerf(*command).code == 0  # requests to a process that has ended are not heeded


@pytest.mark.parametrize("bad", [["--jobs", "0"], ["--cluster", "cloud"], ["--cluster-options", "x.toml"], ["--preset", "no"], ["--set", "train.no=1"]])
def test_mistakes_are_found_before_anything_runs(enerf: Enerf, scenes: Path, tmp_path: Path, bad: list[str]) -> None:
    assert enerf("fleet", scenes, "--out", tmp_path / "fleet", *bad).code == 2
    assert not (tmp_path / "fleet").exists()


def test_pages_are_not_written_through_links(enerf: Enerf, scenes: Path, tmp_path: Path) -> None:
    fleet = tmp_path / "fleet"
    command = ["fleet", scenes / "s1", scenes / "s2", "--out", fleet, "--preset", "tiny"]
    assert enerf(*command).code == 0
    (tmp_path / "pictures").mkdir()
    shutil.rmtree(fleet / "thumbnails")
    (fleet / "thumbnails").symlink_to(tmp_path / "pictures")
    told = enerf(*command)
    assert (told.code, "thumbnails" in told.err) == (4, True)
    assert list((tmp_path / "pictures").iterdir()) == []
