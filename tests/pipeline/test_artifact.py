import itertools
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline import artifact, files
from pipeline.artifact import Workplace
from pipeline.errors import StageFailed
from pipeline.manifest import Manifest, Request, read_manifest
from pipeline.stage import Stage
from tests.pipeline.kills import run_and_kill
from tests.pipeline.toy import NoSettings, contents

STAGE = Stage("train", 1, NoSettings, (), lambda job: None, volatile=("log/*", "*.tmp"))


def request(number: int) -> Request:
    return Request("train", 1, {"number": number}, {})


def sealed(run: Path, number: int) -> Workplace:
    """The work folder of a finished, unpublished artifact."""
    place = artifact.workplace(run, "train", request(number))
    artifact.prepare(place, run / artifact.WORK)
    (place.scratch / "checkpoint").write_text("state")
    (place.out / "sub").mkdir()
    (place.out / "a.txt").write_text(f"number {number}")
    (place.out / "sub" / "b.txt").write_text(f"number {number}")
    artifact.seal(place.out, Manifest(request(number), artifact.outputs_of(place.out, STAGE)))
    return place


def published(run: Path, number: int) -> None:
    run.mkdir(exist_ok=True)
    artifact.publish(run, "train", sealed(run, number))


def test_outputs_are_hashed_and_the_volatile_ones_marked(tmp_path: Path) -> None:
    (tmp_path / "log").mkdir()
    for name in ("a", "log/x", "b.tmp"):
        (tmp_path / name).write_text(name)
    outputs = artifact.outputs_of(tmp_path, STAGE)
    assert {name: output.volatile for name, output in outputs.items()} == {"a": False, "log/x": True, "b.tmp": True}
    assert outputs["log/x"].size == 5


@pytest.mark.parametrize("kind", ["nothing", "link", "pipe", "manifest"])
def test_outputs_that_are_refused(tmp_path: Path, kind: str) -> None:
    if kind == "link":
        (tmp_path / "a").symlink_to("/etc/hosts")
    elif kind == "pipe":
        os.mkfifo(tmp_path / "a")
    elif kind == "manifest":
        (tmp_path / "manifest.json").write_text("{}")
    with pytest.raises(StageFailed, match="train"):
        artifact.outputs_of(tmp_path, STAGE)


def test_differences_name_what_is_altered_missing_and_too_much(tmp_path: Path) -> None:
    run = tmp_path / "run"
    published(run, 1)
    outputs = read_manifest(run / "train").outputs
    assert artifact.differences(run / "train", outputs) == artifact.Differences()
    (run / "train" / "a.txt").write_text("number 2")
    (run / "train" / "sub").rename(tmp_path / "elsewhere")
    (run / "train" / "sub").symlink_to(tmp_path / "elsewhere")
    assert artifact.differences(run / "train", outputs).damaged == ("a.txt", "sub/b.txt"), "what is behind a link is no output"
    (run / "train" / "sub").unlink()
    (run / "train" / "sub").mkdir()
    (run / "train" / "sub" / "c.txt").write_text("")
    found = artifact.differences(run / "train", outputs)
    assert found == artifact.Differences(("a.txt",), ("sub/b.txt",), ("sub/c.txt",))
    assert found.text() == "a.txt altered; sub/b.txt gone"
    (run / "train" / "sub" / "b.txt").symlink_to(tmp_path / "elsewhere" / "b.txt")
    assert artifact.differences(run / "train", outputs).altered == ("a.txt", "sub/b.txt")
    assert artifact.listed("abcdefg") == "a, b, c and 4 more"


def test_a_new_request_drops_the_scratch_of_another_and_keeps_its_own(tmp_path: Path) -> None:
    work = tmp_path / artifact.WORK
    one, two = artifact.workplace(tmp_path, "train", request(1)), artifact.workplace(tmp_path, "train", request(2))
    assert artifact.prepare(one, work) is False
    (one.out / "half").write_text("1")
    artifact.abandon(one, work)
    assert os.listdir(work) == []
    artifact.prepare(one, work)
    (one.scratch / "checkpoint").write_text("1")
    (one.out / "half").write_text("1")
    assert artifact.prepare(one, work) is True
    assert files.is_empty(one.out)
    (one.out / "half").write_text("1")
    artifact.abandon(one, work)
    assert contents(work) == {f"train/{one.request}/scratch/checkpoint": b"1"}
    assert artifact.prepare(two, work) is False
    assert not one.folder.exists()


def both(run: Path) -> None:
    published(run, 2)
    shutil.copytree(run / "train", run / artifact.WORK / "old-train")


def only_old(run: Path) -> None:
    published(run, 1)
    (run / "train").rename(run / artifact.WORK / "old-train")


def old_and_a_whole_new_one(run: Path) -> None:
    only_old(run)
    sealed(run, 2)


def old_and_half_a_new_one(run: Path) -> None:
    only_old(run)
    (sealed(run, 2).out / "manifest.json").write_text("{")


def old_and_something_else_in_its_place(run: Path) -> None:
    only_old(run)
    (run / "train").mkdir()
    (run / "train" / "junk").write_text("")


STATES = [(both, 2), (only_old, 1), (old_and_a_whole_new_one, 2), (old_and_half_a_new_one, 1), (old_and_something_else_in_its_place, 1)]


@pytest.mark.parametrize(("state", "number"), STATES)
def test_recovery_from_each_state(tmp_path: Path, state: Callable[[Path], None], number: int) -> None:
    run = tmp_path / "run"
    state(run)
    assert len(artifact.recover(run, ["train"])) == 1
    made = read_manifest(run / "train")
    assert made.request.settings["number"] == number
    assert not artifact.differences(run / "train", made.outputs).damaged
    assert not (run / artifact.WORK / "old-train").exists()
    assert artifact.recover(run, ["train"]) == []


def test_publishing_killed_before_every_step(tmp_path: Path) -> None:
    """Whatever stands after recovery is whole, is the old or the new, and the other is gone."""
    seen = set()
    for moment in itertools.count(1):
        run = tmp_path / f"run{moment}"
        published(run, 1)
        killed = run_and_kill(lambda run=run: published(run, 2), moment)  # type: ignore[misc]
        artifact.recover(run, ["train"])
        made = read_manifest(run / "train")
        assert artifact.differences(run / "train", made.outputs) == artifact.Differences()
        seen.add(made.request.settings["number"])
        published(run, 2)
        assert contents(run) == {"train/a.txt": b"number 2", "train/sub/b.txt": b"number 2"}
        assert os.listdir(run / artifact.WORK) == []
        if not killed:
            break
    assert moment > 12
    assert seen == {1, 2}


@pytest.mark.parametrize(("state", "number"), STATES[:4])
def test_recovery_killed_before_every_step(tmp_path: Path, state: Callable[[Path], None], number: int) -> None:
    for moment in itertools.count(1):
        run = tmp_path / str(moment)
        state(run)
        killed = run_and_kill(lambda run=run: artifact.recover(run, ["train"]), moment)  # type: ignore[misc]
        artifact.recover(run, ["train"])
        made = read_manifest(run / "train")
        assert made.request.settings["number"] == number
        assert not artifact.differences(run / "train", made.outputs).damaged
        assert not [path for path in (run / artifact.WORK).iterdir() if path.name.startswith(("old-", "trash-"))]
        if not killed:
            break
