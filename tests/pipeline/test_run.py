import json
import os
from pathlib import Path
from typing import Any

import pytest

from pipeline.errors import BadInput, CorruptArtifact
from pipeline.run import Run


def test_there_and_back(tmp_path: Path) -> None:
    Run(tmp_path / "a" / "run", tmp_path).check_free()
    assert not (tmp_path / "a").exists()
    made = Run.create(tmp_path / "a" / "run", tmp_path, {"train": {"iterations": 5}}, preset="tiny", seed=3, device="cpu")
    assert Run.open(made.path) == made
    value = json.loads((made.path / "run.json").read_text())
    assert (value["format"], value["version"]) == ("enerf-run", 1)
    made.update(settings={"train": {"iterations": 7}}, preset="high")
    assert Run.open(made.path) == made
    before = os.stat(made.path / "run.json").st_ino
    made.update(preset="high", source=tmp_path)
    assert os.stat(made.path / "run.json").st_ino == before, "nothing has changed"


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
    Run.create(tmp_path / "run")
    for name in ("file", "folder", "file/run", "run"):
        with pytest.raises(BadInput, match=name):
            Run.create(tmp_path / name)
    for name in ("none", "file", "folder"):
        with pytest.raises(BadInput, match=name):
            Run.open(tmp_path / name)
    assert os.listdir(tmp_path / "folder") == ["thesis.txt"]


@pytest.mark.parametrize(
    ("change", "error", "field"),
    [
        ({"version": 2}, BadInput, "format 2; this build reads 1"),
        ({"version": 0}, CorruptArtifact, "version"),
        ({"version": True}, CorruptArtifact, "version"),
        ({"version": 10**400}, BadInput, "newer version"),
        ({"format": "blend"}, BadInput, "run"),
        ({"source": 5}, CorruptArtifact, "source"),
        ({"source": "/a\0b"}, CorruptArtifact, "source"),
        ({"source": "/\ud800"}, CorruptArtifact, "surrogates"),
        ({"source": "../.."}, CorruptArtifact, "source"),
        ({"source": "/" + "x" * 5000}, CorruptArtifact, "source"),
        ({"settings": {"train": {"x": [[[]]] * 3}}, "preset": ["a"]}, CorruptArtifact, "preset"),
        ({"settings": {"train": 5}}, CorruptArtifact, "settings"),
        ({"seed": 10**400}, CorruptArtifact, "seed"),
        ({"device": 1}, CorruptArtifact, "device"),
        ({"created": 10**400}, CorruptArtifact, "created"),
        ("{", CorruptArtifact, "run.json"),
        ("\0", CorruptArtifact, "run.json"),
    ],
)
def test_a_hostile_run_json(tmp_path: Path, change: dict[str, Any] | str, error: type[Exception], field: str) -> None:
    run = Run.create(tmp_path / "run")
    (run.path / "run.json").write_text(change if isinstance(change, str) else json.dumps({**run.plain(), **change}))
    with pytest.raises(error, match=field) as caught:
        Run.open(run.path)
    assert "\n" not in str(caught.value)


def test_what_another_changed_is_read_under_the_lock(tmp_path: Path) -> None:
    run = Run.create(tmp_path / "run", tmp_path, {"train": {"iterations": 5}})
    other = Run.open(run.path)
    other.update(settings={"train": {"iterations": 7}})
    run.update(preset="high")
    assert Run.open(run.path).settings == {"train": {"iterations": 7}}
    other.update(settings={"train": {"iterations": 9}})
    with run.locked():
        assert run.settings == {"train": {"iterations": 9}}
