from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from pipeline import files
from pipeline.errors import BadInput, CorruptArtifact, DiskFull
from pipeline.run import Run


def test_there_and_back(tmp_path: Path) -> None:
    made = Run.create(tmp_path / "a" / "run", tmp_path, {"train": {"iterations": 5}}, preset="tiny", seed=3, device="cpu")
    assert Run.open(tmp_path / "a" / "run") == made
    value = json.loads((made.path / "run.json").read_text())
    assert (value["format"], value["version"]) == ("enerf-run", 1)


def test_a_plan_writes_nothing(tmp_path: Path) -> None:
    run = Run(tmp_path / "run", tmp_path)
    run.check_free()
    assert not run.path.exists()


def test_paths_become_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run = Run.create(Path("run"), Path("photos"))
    assert run.path == tmp_path / "run"
    assert run.source == tmp_path / "photos"
    assert run.how_to_resume(until="count") == f"run the stages until count of {tmp_path}/run"


def test_messages_name_the_command_that_a_workflow_gives(tmp_path: Path) -> None:
    def command(run: Path, *, until: str | None = None, only: str | None = None, with_source: bool = False, **more: Any) -> str:
        return f"make {run.name} {until} {only} {with_source}"

    run = Run.create(tmp_path / "run", resume_text=command)
    assert run.how_to_resume(until="bake") == "make run bake None False"
    assert run.how_to_resume(only="bake", with_source=True) == "make run None bake True"
    assert Run.open(run.path, command).how_to_resume() == "make run None None False"
    with pytest.raises(BadInput, match=r"Go on with it \(make run None None False\)"):
        run.check_free()
    assert Run.open(run.path) == run


def test_an_empty_folder_will_do_and_so_will_what_a_kill_left(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    for name in (".lock", ".lock.json", ".run.json.7.part"):
        (tmp_path / "run" / name).write_text("{")
    Run.create(tmp_path / "run")
    assert sorted(os.listdir(tmp_path / "run")) == [".lease", ".lock", "run.json"]


def test_something_else_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis.txt").write_text("mine")
    with pytest.raises(BadInput, match="not a folder"):
        Run.create(tmp_path / "file")
    with pytest.raises(BadInput, match=r"exists and is not a run.*thesis"):
        Run.create(tmp_path / "folder")
    with pytest.raises(BadInput, match="cannot be written"):
        Run.create(tmp_path / "file" / "run")
    assert os.listdir(tmp_path / "folder") == ["thesis.txt"]
    Run.create(tmp_path / "run")
    with pytest.raises(BadInput, match="is a run already"):
        Run.create(tmp_path / "run")


def test_open_says_what_it_found(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="no such folder"):
        Run.open(tmp_path / "none")
    with pytest.raises(BadInput, match="is not a run"):
        Run.open(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match="not a folder"):
        Run.open(tmp_path / "file")


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"version": 2}, BadInput, "run format 2; this build reads 1"),
        ({"version": 0}, CorruptArtifact, "version is 0"),
        ({"version": True}, CorruptArtifact, "version is True"),
        ({"format": "blend"}, BadInput, "not of a run"),
        ({"source": 5}, CorruptArtifact, "source is 5"),
        ({"source": "/a\0b"}, CorruptArtifact, "source"),
        ({"source": "/\ud800"}, CorruptArtifact, "source"),
        ({"source": "../.."}, CorruptArtifact, "source"),
        ({"source": "/" + "x" * 5000}, CorruptArtifact, "source"),
        ({"seed": 10**400}, CorruptArtifact, "seed"),
        ({"version": 10**400}, BadInput, "newer version"),
        ({"settings": {"train": {"x": [[[]]] * 3}}, "preset": ["a"]}, CorruptArtifact, "preset"),
        ({"settings": []}, CorruptArtifact, "settings"),
        ({"settings": {"train": 5}}, CorruptArtifact, "settings"),
        ({"seed": "1"}, CorruptArtifact, "seed"),
        ({"preset": 1}, CorruptArtifact, "preset"),
        ({"device": 1}, CorruptArtifact, "device"),
        ({"created": "x"}, CorruptArtifact, "created"),
        ({"created": 10**400}, CorruptArtifact, "created"),
    ],
)
def test_a_hostile_run_json(tmp_path: Path, change: dict[str, Any], error: type[Exception], message: str) -> None:
    run = Run.create(tmp_path / "run")
    (run.path / "run.json").write_text(json.dumps({**run.plain(), **change}))
    with pytest.raises(error, match=message) as caught:
        Run.open(run.path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "\0", "[1]" * 3])
def test_a_damaged_run_json(tmp_path: Path, text: str) -> None:
    run = Run.create(tmp_path / "run")
    (run.path / "run.json").write_text(text)
    with pytest.raises(CorruptArtifact, match=r"run\.json"):
        Run.open(run.path)


def test_update_is_written_only_if_it_changes_something(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = Run.create(tmp_path / "run", tmp_path)
    run.update(settings={"train": {"iterations": 7}}, preset="high")
    assert Run.open(run.path) == run
    before = os.stat(run.path / "run.json").st_ino
    run.update(preset="high", source=tmp_path)
    assert os.stat(run.path / "run.json").st_ino == before
    with pytest.raises(TypeError, match="colour"):
        run.update(colour="red")


def test_what_another_changed_is_read_under_the_lock(tmp_path: Path) -> None:
    run = Run.create(tmp_path / "run", tmp_path, {"train": {"iterations": 5}})
    other = Run.open(run.path)
    other.update(settings={"train": {"iterations": 7}})
    run.update(preset="high")
    assert Run.open(run.path).settings == {"train": {"iterations": 7}}
    other.update(settings={"train": {"iterations": 9}})
    with run.locked():
        assert run.settings == {"train": {"iterations": 9}}


def test_a_full_disk_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = Run.create(tmp_path / "run", tmp_path)

    def full(path: Path, data: bytes) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files, "write_atomically", full)
    with pytest.raises(DiskFull, match="MiB free"):
        run.update(preset="high")
    monkeypatch.undo()
    assert run.preset is None
    assert Run.open(run.path) == run
