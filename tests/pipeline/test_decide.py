import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline import artifact
from pipeline.decide import decide, survey
from pipeline.errors import BadInput
from pipeline.run import Run
from pipeline.runner import run_stages
from pipeline.stage import Stage
from tests.pipeline.toy import COUNT, DOUBLE, LIST, REPORT, STAGES, make_run, set_one


def why_run(stage: Stage, run: Run) -> str | None:
    return decide(stage, run).reason


@pytest.fixture
def done(tmp_path: Path) -> Run:
    run = make_run(tmp_path)
    run_stages(run, STAGES)
    return run


def states(run: Run) -> dict[str, str]:
    return {decision.stage: decision.state for decision in survey(STAGES, run)}


def test_never_run_and_nothing_to_do(tmp_path: Path) -> None:
    run = make_run(tmp_path)
    assert set(states(run).values()) == {"missing"}
    run_stages(run, STAGES)
    assert [why_run(stage, run) for stage in STAGES] == [None] * 4
    assert [decision.note for decision in survey(STAGES, run)] == [None] * 4


def test_settings_and_versions_that_changed_are_named(done: Run) -> None:
    set_one(done, "count", steps=9, name="x")
    assert why_run(COUNT, done) == 'settings changed: name null -> "x", steps 6 -> 9'
    assert why_run(DOUBLE, done) is None  # its inputs are as they were, as yet
    assert states(done) == {"list": "fresh", "count": "stale", "double": "stale", "report": "stale"}
    (done.folder("count") / "count.txt").unlink()
    reasons = (why_run(replace(COUNT, version=2), done) or "").split("; ")
    assert [reason.partition(":")[0] for reason in reasons] == ["output altered on disk", "version changed", "settings changed"]


def test_an_input_stage_changed(done: Run) -> None:
    set_one(done, "list", upper=True)
    run_stages(done, STAGES, until="list")
    assert why_run(COUNT, done) == "inputs changed: list"
    assert why_run(REPORT, done) == "inputs changed: list"
    assert why_run(DOUBLE, done) is None


def test_source_files_changed(done: Run, tmp_path: Path) -> None:
    assert done.source is not None
    (done.source / "notes.txt").write_text("does not matter")
    assert why_run(LIST, done) is None
    (done.source / "1.jpg").write_bytes(b"other")
    (done.source / "0.jpg").rename(done.source / "9.jpg")
    assert why_run(LIST, done) == "inputs changed: 3 source files (1 changed: 1.jpg; 1 new: 9.jpg; 1 gone: 0.jpg)"
    assert set(states(done).values()) == {"stale"}
    for number, listed in enumerate((None, lambda source, settings: [source / "9.jpg", source / "later.jpg"])):  # every file; one that is yet to come
        run, stage = Run.create(tmp_path / str(number), done.source), replace(LIST, source_files=listed)
        run_stages(run, [stage])
        assert why_run(stage, run) is None
        (done.source / "later.jpg").write_bytes(b"%d" % number)
        assert "1 source file (1 " in (why_run(stage, run) or "")
        (done.source / "later.jpg").unlink()


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


def test_settings_of_another_version_are_no_settings(done: Run) -> None:
    done.update(settings={**done.settings, "list": {**done.settings.get("list", {}), "removed_since": 3}})
    assert set(states(done).values()) == {"fresh"}
    set_one(done, "list", upper=True)
    assert why_run(LIST, done) == "settings changed: upper false -> true"


@pytest.mark.parametrize("name", ["count.txt", "log.jsonl"])
def test_an_altered_output_is_corrupt_and_a_file_too_many_is_not(done: Run, name: str) -> None:
    path = done.folder("count") / name
    (path.parent / "extra.txt").write_text("")
    decision = decide(COUNT, done)
    assert decision.fresh
    assert decision.extra == ("extra.txt",)
    path.write_bytes(path.read_bytes()[::-1])  # of the same size
    assert why_run(COUNT, done) == f"output altered on disk: {name} altered"
    path.unlink()  # those that depend on the clock are part of it, too
    assert why_run(COUNT, done) == f"output altered on disk: {name} gone"
    assert states(done) == {"list": "fresh", "count": "corrupt", "double": "stale", "report": "stale"}


@pytest.mark.parametrize("text", [None, "", "{}", '{"format": "enerf-manifest"', "another stage's"])
def test_an_unreadable_manifest_is_corrupt(done: Run, text: str | None) -> None:
    path = done.folder("count") / "manifest.json"
    path.unlink()
    if text == "another stage's":
        shutil.copy(done.folder("double") / "manifest.json", path)
    elif text is not None:
        path.write_text(text)
    assert states(done) == {"list": "fresh", "count": "corrupt", "double": "stale", "report": "stale"}


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


def test_a_moved_copy_stays_fresh_though_every_inode_is_new(done: Run, tmp_path: Path) -> None:
    shutil.copytree(done.path, tmp_path / "copy")
    assert done.source is not None
    shutil.rmtree(done.source)
    copy = Run.open(shutil.move(tmp_path / "copy", tmp_path / "moved"))
    assert set(states(copy).values()) == {"fresh"}
    assert all(outcome.action == "skipped" for outcome in run_stages(copy, STAGES))
