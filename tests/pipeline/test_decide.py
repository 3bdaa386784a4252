from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline import artifact
from pipeline.decide import decide, survey
from pipeline.errors import BadInput, Interrupted, UnknownSetting
from pipeline.hashes import Hashes
from pipeline.run import Run
from pipeline.runner import run_stages
from pipeline.stage import Stage
from tests.pipeline.toy import COUNT, DOUBLE, LIST, REPORT, STAGES, make_run, set_one


def why_run(stage: Stage, run: Run) -> str | None:
    return decide(stage, run).reason


def tree(folder: Path) -> dict[str, tuple[int, int]]:
    return {str(path): (path.lstat().st_mtime_ns, path.lstat().st_size) for path in folder.rglob("*")}


@pytest.fixture
def done(tmp_path: Path) -> Run:
    run = make_run(tmp_path)
    run_stages(run, STAGES)
    return run


def states(run: Run) -> dict[str, str]:
    return {decision.stage: decision.state for decision in survey(STAGES, run)}


def test_never_run(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    assert [why_run(stage, run) for stage in STAGES] == ["never run"] * 4
    assert set(states(run).values()) == {"missing"}


def test_nothing_to_do(done: Run) -> None:
    assert [why_run(stage, done) for stage in STAGES] == [None] * 4
    assert [decision.note for decision in survey(STAGES, done)] == [None] * 4


def test_looking_changes_nothing(done: Run) -> None:
    shutil.rmtree(done.path / ".cache", ignore_errors=True)  # what was written a moment ago may not be remembered
    set_one(done, "count", steps=9)
    before = tree(done.path.parent)
    survey(STAGES, done)
    assert tree(done.path.parent) == before


def test_settings_changed_says_which(done: Run) -> None:
    set_one(done, "count", steps=9, name="x")
    assert why_run(COUNT, done) == 'settings changed: name null -> "x", steps 6 -> 9'
    assert why_run(DOUBLE, done) is None  # its inputs are as they were, as yet
    assert states(done) == {"list": "fresh", "count": "stale", "double": "stale", "report": "stale"}
    assert survey(STAGES, done)[3].reason == "inputs changed: double is stale"
    set_one(done, "count", steps=6, name=None)
    assert why_run(COUNT, done) is None


def test_version_changed(done: Run) -> None:
    assert why_run(replace(COUNT, version=2), done) == "version changed: 1 -> 2"


def test_several_reasons_are_all_given(done: Run) -> None:
    set_one(done, "count", rate=1.0)
    (done.folder("count") / "count.txt").unlink()
    reason = why_run(replace(COUNT, version=2), done)
    assert reason == "output altered on disk: count.txt gone; version changed: 1 -> 2; settings changed: rate 0.5 -> 1.0"


def test_an_input_stage_changed(done: Run) -> None:
    set_one(done, "list", upper=True)
    run_stages(done, STAGES, until="list")
    assert why_run(COUNT, done) == "inputs changed: list"
    assert why_run(REPORT, done) == "inputs changed: list"
    assert why_run(DOUBLE, done) is None


def test_source_files_changed(done: Run) -> None:
    assert done.source is not None
    (done.source / "notes.txt").write_text("does not matter")
    assert why_run(LIST, done) is None
    (done.source / "1.jpg").write_bytes(b"other")
    assert why_run(LIST, done) == "inputs changed: 1 source file (1 changed: 1.jpg)"
    (done.source / "0.jpg").rename(done.source / "9.jpg")
    assert why_run(LIST, done) == "inputs changed: 3 source files (1 changed: 1.jpg; 1 new: 9.jpg; 1 gone: 0.jpg)"
    assert states(done) == {"list": "stale", "count": "stale", "double": "stale", "report": "stale"}


def test_a_listed_source_file_that_is_missing_is_part_of_the_request(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    stage = replace(LIST, source_files=lambda source, settings: [source / "0.jpg", source / "later.jpg"])
    run_stages(run, [stage])
    assert why_run(stage, run) is None
    assert run.source is not None
    (run.source / "later.jpg").write_bytes(b"here")
    assert why_run(stage, run) == "inputs changed: 1 source file (1 changed: later.jpg)"


def test_without_a_list_every_file_of_the_source_counts(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    stage = replace(LIST, source_files=None)
    run_stages(run, [stage])
    assert run.source is not None
    (run.source / "notes.txt").write_text("matters now")
    assert why_run(stage, run) == "inputs changed: 1 source file (1 changed: notes.txt)"


@pytest.mark.parametrize("how", ["gone", "empty"])
def test_a_vanished_source_leaves_all_fresh_with_a_note(done: Run, how: str) -> None:
    assert done.source is not None
    shutil.rmtree(done.source)
    if how == "empty":
        done.source.mkdir()
    assert set(states(done).values()) == {"fresh"}
    assert "is not there" in (decide(LIST, done).note or "")
    set_one(done, "list", upper=True)
    assert why_run(LIST, done) == "settings changed: upper false -> true"


def test_a_source_that_can_no_longer_be_read_is_a_change(done: Run) -> None:
    def refuse(source: Path, settings: object) -> list[Path]:
        raise BadInput("transforms.json: has no frames")

    decision = decide(replace(LIST, source_files=refuse), done)
    assert (decision.state, decision.reason) == ("stale", "inputs changed: transforms.json: has no frames")


def test_hashing_the_source_can_be_interrupted(done: Run) -> None:
    def stop() -> None:
        raise Interrupted()

    with pytest.raises(Interrupted):
        decide(LIST, done, Hashes(safe_point=stop))


def test_an_altered_output_is_corrupt(done: Run) -> None:
    (done.folder("count") / "count.txt").write_text("altered")
    assert why_run(COUNT, done) == "output altered on disk: count.txt altered"
    assert states(done) == {"list": "fresh", "count": "corrupt", "double": "stale", "report": "stale"}


def test_a_file_of_the_same_size_is_noticed(done: Run) -> None:
    path = done.folder("double") / "double.txt"
    path.write_bytes(path.read_bytes()[::-1])
    assert why_run(DOUBLE, done) == "output altered on disk: double.txt altered"


def test_a_volatile_output_is_part_of_the_artifact(done: Run) -> None:
    (done.folder("count") / "log.jsonl").unlink()
    assert why_run(COUNT, done) == "output altered on disk: log.jsonl gone"


def test_a_file_too_many_is_no_reason_but_is_told(done: Run) -> None:
    (done.folder("count") / "extra.txt").write_text("")
    decision = decide(COUNT, done)
    assert decision.fresh
    assert decision.extra == ("extra.txt",)


@pytest.mark.parametrize("text", [None, "", "{}", '{"format": "enerf-manifest"'])
def test_an_unreadable_manifest_is_corrupt(done: Run, text: str | None) -> None:
    path = done.folder("count") / "manifest.json"
    path.unlink()
    if text is not None:
        path.write_text(text)
    assert (why_run(COUNT, done) or "").startswith("manifest unreadable: count/manifest.json: ")
    assert states(done) == {"list": "fresh", "count": "corrupt", "double": "stale", "report": "stale"}


def test_a_manifest_of_another_stage_is_corrupt(done: Run) -> None:
    shutil.rmtree(done.folder("double"))
    shutil.copytree(done.folder("count"), done.folder("double"))
    assert decide(DOUBLE, done).state == "corrupt"


def test_a_missing_artifact_makes_what_follows_stale(done: Run) -> None:
    shutil.rmtree(done.folder("count"))
    assert states(done) == {"list": "fresh", "count": "missing", "double": "stale", "report": "stale"}
    assert why_run(DOUBLE, done) == "inputs changed: double needs count, which this run does not have."


def test_work_that_was_cut_short_is_partial(done: Run) -> None:
    set_one(done, "count", steps=9)
    request = decide(COUNT, done).request
    assert request is not None
    place = artifact.workplace(done.path, "count", request)
    artifact.prepare(place, done.path / artifact.WORK)
    assert why_run(COUNT, done) == "incomplete: cut short; it starts anew; settings changed: steps 6 -> 9"
    (place.scratch / "state.txt").write_text("0")
    assert why_run(COUNT, done) == "incomplete: cut short; it goes on where it stopped; settings changed: steps 6 -> 9"
    assert states(done)["count"] == "partial"
    set_one(done, "count", steps=10)  # the scratch is not of this request
    assert states(done)["count"] == "stale"
    shutil.rmtree(done.folder("count"))
    assert states(done)["count"] == "missing"


def test_a_swap_that_was_cut_short_is_partial(done: Run) -> None:
    (done.path / artifact.WORK).mkdir(exist_ok=True)
    done.folder("count").rename(done.path / artifact.WORK / "old-count")
    assert decide(COUNT, done).state == "partial"
    run_stages(done, STAGES)
    assert set(states(done).values()) == {"fresh"}


def test_a_moved_run_stays_fresh(done: Run, tmp_path: Path) -> None:
    moved = tmp_path / "elsewhere" / "run"
    moved.parent.mkdir()
    shutil.move(done.path, moved)
    assert done.source is not None
    shutil.rmtree(done.source)
    assert set(states(Run.open(moved)).values()) == {"fresh"}


def test_a_copied_run_stays_fresh_though_every_inode_is_new(done: Run, tmp_path: Path) -> None:
    os.system(f"cp -a '{done.path}' '{tmp_path}/copy'")
    copy = Run.open(tmp_path / "copy")
    assert set(states(copy).values()) == {"fresh"}
    assert all(outcome.action == "skipped" for outcome in run_stages(copy, STAGES))


def test_settings_that_no_stage_has_are_refused(done: Run) -> None:
    set_one(done, "count", stepps=5)
    with pytest.raises(UnknownSetting, match=r"count\.stepps.*count\.steps"):
        why_run(COUNT, done)


def test_settings_are_compared_as_values(done: Run) -> None:
    set_one(done, "count", rate=0.50)
    assert why_run(COUNT, done) is None
    del done.settings["count"]["rate"]  # the default
    assert why_run(COUNT, done) is None
