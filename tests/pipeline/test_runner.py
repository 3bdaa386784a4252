import errno
import itertools
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from pipeline import artifact
from pipeline.decide import decide, survey
from pipeline.errors import BadInput, CorruptArtifact, DiskFull, Interrupted, StageFailed, UsageError
from pipeline.executors import local
from pipeline.executors.local import Usage
from pipeline.manifest import read_manifest
from pipeline.run import Run
from pipeline.runner import run_stages, verify
from pipeline.stage import Job, Stage
from tests.pipeline.kills import run_and_kill
from tests.pipeline.toy import COUNT, LIST, STAGES, Events, actions, contents, make_run, raising, replaced, set_one


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return make_run(tmp_path)


def test_all_run_once_and_then_nothing(run: Run) -> None:
    events = Events()
    outcomes = run_stages(run, STAGES, report=events)
    assert actions(outcomes) == {"list": "ran", "count": "ran", "double": "ran", "report": "ran"}
    assert {outcome.reason for outcome in outcomes} == {"never run"}
    assert [event["stage"] for event in events.named("stage_done")] == ["list", "count", "double", "report"]
    assert all({"event", "stage", "time"} <= event.keys() for event in events)
    assert os.listdir(run.path / artifact.WORK) == []
    before = {path: path.lstat().st_mtime_ns for path in run.path.rglob("*") if ".lease" not in path.parts}

    events = Events()
    again = run_stages(run, STAGES, report=events)
    assert [outcome.digest for outcome in again] == [outcome.digest for outcome in outcomes]
    assert set(actions(again).values()) == {"skipped"}
    assert [event["event"] for event in events] == ["stage_skipped"] * 4
    after = {path: path.lstat().st_mtime_ns for path in run.path.rglob("*") if ".lease" not in path.parts}
    assert {path for path in before | after if before.get(path) != after.get(path)} <= {run.path, run.path / ".cache", run.cache}


def test_the_manifest_says_what_made_it(run: Run) -> None:
    run_stages(run, STAGES, until="count")
    made = read_manifest(run.folder("count"))
    assert made.request.settings == {"steps": 6, "rate": 0.5, "name": None}
    assert made.request.inputs == {"list": read_manifest(run.folder("list")).digest}
    assert made.outputs["log.jsonl"].volatile
    assert made.peak_memory > 2**20
    assert made.cpu_seconds >= 0
    assert made.cores >= 1
    assert made.facts == {"counted": {"steps": 6}}
    assert not made.resumed
    assert sorted(read_manifest(run.folder("list")).request.source or {}) == ["0.jpg", "1.jpg", "2.jpg"]


def test_only_what_changed_runs_again(run: Run) -> None:
    run_stages(run, STAGES)
    set_one(run, "count", steps=9)
    assert actions(run_stages(run, STAGES)) == {"list": "skipped", "count": "ran", "double": "ran", "report": "ran"}
    (run.folder("count") / "count.txt").write_text("altered")
    assert actions(run_stages(run, STAGES)) == {"list": "skipped", "count": "ran", "double": "skipped", "report": "skipped"}
    before = read_manifest(run.folder("count"))
    assert actions(run_stages(run, replaced("count", version=2))) == {"list": "skipped", "count": "ran", "double": "skipped", "report": "skipped"}
    after = read_manifest(run.folder("count"))
    assert before.outputs["log.jsonl"] != after.outputs["log.jsonl"]
    assert before.digest == after.digest


def test_until_from_and_force(run: Run) -> None:
    assert actions(run_stages(run, STAGES, until="double")) == {"list": "ran", "count": "ran", "double": "ran"}
    assert actions(run_stages(run, STAGES, start="count", until="count")) == {"list": "skipped", "count": "ran"}
    assert actions(run_stages(run, STAGES, start="double")) == {"list": "skipped", "count": "skipped", "double": "ran", "report": "ran"}
    assert set(actions(run_stages(run, STAGES, force=True)).values()) == {"ran"}
    for selection in ({"start": "double", "until": "list"}, {"only": "double", "until": "list"}):
        with pytest.raises(UsageError):
            run_stages(run, STAGES, **selection)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match=r"Did you mean count\?"):
        run_stages(run, STAGES, until="cuont")


def test_one_stage_alone_uses_what_there_is_and_warns_of_what_is_stale(run: Run) -> None:
    run_stages(run, STAGES)
    assert actions(run_stages(run, STAGES, only="double")) == {"double": "skipped"}
    set_one(run, "count", steps=9)
    events = Events()
    assert actions(run_stages(run, STAGES, only="report", force=True, report=events)) == {"report": "ran"}
    assert [(warning["about"], warning["state"]) for warning in events.named("warning")] == [("count", "stale"), ("double", "stale")]
    assert read_manifest(run.folder("count")).request.settings["steps"] == 6


def test_one_stage_alone_without_what_it_needs(run: Run) -> None:
    events = Events()
    with pytest.raises(BadInput, match="run the stages until count of "):
        run_stages(run, STAGES, only="count", report=events)
    assert events.named("warning") == [], "that it uses what there is"
    run_stages(run, STAGES)
    for name in ("count.txt", "manifest.json"):
        (run.folder("count") / name).write_text("{")
        with pytest.raises(CorruptArtifact) as caught:
            run_stages(run, STAGES, only="double", force=True)
        assert f"count/{name}" in caught.value.files


def test_a_dry_run_says_what_would_be_done_and_does_nothing(run: Run, tmp_path: Path) -> None:
    events = Events()
    assert set(actions(run_stages(run, STAGES, dry_run=True, report=events)).values()) == {"would run"}
    assert sorted(os.listdir(run.path)) == [".lease", ".lock", "run.json"]
    assert "list: would run (never run)" in events.text()
    run_stages(run, STAGES)
    set_one(run, "count", steps=9)
    planned = {"list": "skipped", "count": "would run", "double": "may run", "report": "may run"}
    assert actions(run_stages(run, STAGES, dry_run=True)) == planned
    assert actions(run_stages(run, STAGES, dry_run=True, start="report"))["report"] == "would run"
    assert actions(run_stages(run, STAGES, dry_run=True, only="double")) == {"double": "skipped"}
    assert actions(run_stages(Run(tmp_path / "new", run.source), STAGES, dry_run=True, until="list")) == {"list": "would run"}
    assert not (tmp_path / "new").exists()


def test_a_vanished_source(run: Run, tmp_path: Path) -> None:
    run_stages(run, STAGES)
    assert run.source is not None
    shutil.rmtree(run.source)
    events = Events()
    set_one(run, "count", steps=9)
    assert actions(run_stages(run, STAGES, report=events))["report"] == "ran"
    assert str(run.source) in events.text()
    set_one(run, "list", upper=True)
    for each in (run, Run.create(tmp_path / "new", tmp_path / "none"), Run.create(tmp_path / "other")):
        with pytest.raises(BadInput):
            run_stages(each, STAGES)
    assert contents(run.folder("list"))


def test_a_stage_sees_the_source_only_if_it_reads_it(run: Run) -> None:
    seen = {}

    def look(job: Job) -> None:
        seen.update(source=job.source, device=job.device, inputs=job.inputs)
        (job.out / "a").write_text("a")

    run_stages(run, [LIST, Stage("look", 1, COUNT.settings, ("list",), look)], device="cuda")
    assert seen == {"source": None, "device": "cuda", "inputs": {"list": run.folder("list")}}


def test_a_stage_that_raises(run: Run) -> None:
    run_stages(run, STAGES)
    before = contents(run.path)
    set_one(run, "count", steps=9)
    original = ValueError("bad thing\nwith details")
    events = Events()
    with pytest.raises(StageFailed, match=r"^count: ValueError: bad thing$") as caught:
        run_stages(run, replaced("count", run=raising(original)), report=events)
    assert caught.value.__cause__ is original
    assert events.named("stage_failed")[0]["exit_code"] == 3
    assert {**contents(run.path), "run.json": b""} == {**before, "run.json": b""}
    assert os.listdir(run.path / artifact.WORK) == []
    assert actions(run_stages(run, STAGES))["count"] == "ran"


def _wrapped(error: BaseException) -> RuntimeError:
    """As a library hands it on."""
    try:
        raise RuntimeError("could not save") from error
    except RuntimeError as found:
        return found


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (BadInput("photos: none"), BadInput),
        (MemoryError(), StageFailed),
        (RuntimeError(), StageFailed),
        (FileNotFoundError(errno.ENOENT, "No such file", "x.bin"), StageFailed),
        (OSError(errno.ENOSPC, "No space left on device"), DiskFull),
        (_wrapped(OSError(errno.EDQUOT, "Disk quota exceeded", "field.bin")), DiskFull),
        (RuntimeError("database or disk is full"), DiskFull),
    ],
)
def test_what_the_user_sees_of_an_error(run: Run, error: Exception, kind: type[Exception]) -> None:
    with pytest.raises(kind) as caught:
        run_stages(run, replaced("count", run=raising(error)))
    assert type(caught.value) is kind
    assert "\n" not in str(caught.value)
    assert kind is not StageFailed or str(caught.value).startswith("count: ")


def test_a_failed_stage_keeps_its_checkpoint_and_goes_on(run: Run) -> None:
    steps: list[int] = []

    def stumble(job: Job) -> None:
        done = job.work / "done"
        start = int(done.read_text()) if done.exists() else 0
        for step in range(start, 5):
            steps.append(step)
            done.write_text(str(step + 1))
            if step == 2 and start == 0:
                raise RuntimeError("stumbled")
        (job.out / "count.txt").write_text("5")

    stages = replaced("count", run=stumble)
    with pytest.raises(StageFailed):
        run_stages(run, stages)
    assert decide(stages[1], run).state == "partial"
    events = Events()
    run_stages(run, stages, report=events)
    assert steps == [0, 1, 2, 3, 4]
    assert [event["resumed"] for event in events.named("stage_started")] == [True, False, False]
    assert read_manifest(run.folder("count")).resumed
    assert os.listdir(run.path / artifact.WORK) == []


def _count_until(step: int) -> object:
    def count(job: Job) -> None:
        job.stop = lambda: 2 if (job.work / "state.txt").read_text().count("\n") >= step - 1 else None
        COUNT.run(job)

    return count


def test_interrupted_and_resumed_gives_the_same_bytes(run: Run, tmp_path: Path) -> None:
    events = Events()
    with pytest.raises(Interrupted) as caught:
        run_stages(run, replaced("count", run=_count_until(3)), report=events)
    assert caught.value.exit_code == 130
    assert events.named("interrupted")[0]["resume"] == run.how_to_resume()
    assert decide(COUNT, run).reason == "incomplete: cut short; it goes on where it stopped"
    shutil.copytree(run.path, tmp_path / "changed")
    resumed = run_stages(run, STAGES)
    undisturbed = run_stages(make_run(tmp_path / "other"), STAGES)
    assert [outcome.digest for outcome in resumed] == [outcome.digest for outcome in undisturbed]
    changed, events = Run.open(tmp_path / "changed"), Events()
    set_one(changed, "count", rate=2.0)  # a checkpoint of other settings is of no use
    run_stages(changed, STAGES, report=events)
    assert not events.named("stage_started")[0]["resumed"]
    assert b"0.5" not in contents(changed.folder("count"))["count.txt"]


@pytest.mark.parametrize(("error", "code"), [(KeyboardInterrupt(), 130), (Interrupted(15), 143)])
def test_an_interruption_that_a_library_wrapped(run: Run, error: BaseException, code: int) -> None:
    with pytest.raises(Interrupted) as caught:
        run_stages(run, replaced("count", run=raising(_wrapped(error))))
    assert caught.value.exit_code == code


def test_an_interrupted_forced_run_goes_on_when_forced_again(run: Run) -> None:
    run_stages(run, STAGES)
    before = contents(run.path)
    with pytest.raises(Interrupted):
        run_stages(run, replaced("count", run=_count_until(3)), only="count", force=True)
    assert decide(COUNT, run).fresh
    events = Events()
    run_stages(run, STAGES, only="count", force=True, report=events)
    assert events.named("stage_started")[0]["resumed"]
    assert contents(run.path) == before


def test_a_stage_that_was_done_but_not_published_is_not_run_again(run: Run) -> None:
    run_stages(run, STAGES, until="list")
    for moment in itertools.count(1):
        run_and_kill(lambda: run_stages(run, STAGES, until="count"), moment)
        if (decide(COUNT, run).reason or "").startswith("incomplete: done"):
            break
        assert moment < 50
    events = Events()
    outcomes = run_stages(run, replaced("count", run=raising(AssertionError("ran again"))), until="count", report=events)
    assert actions(outcomes)["count"] == "ran"
    assert "only its publication had been cut short" in events.text()


def test_killed_before_every_durable_step_of_a_run(tmp_path: Path) -> None:
    """All four stages over older artifacts: whatever the moment, the next run ends with what an undisturbed one gives."""
    first = make_run(tmp_path)
    run_stages(first, STAGES)
    set_one(first, "list", upper=True)
    set_one(first, "count", steps=4)
    shutil.copytree(first.path, tmp_path / "undisturbed")
    expected = [outcome.digest for outcome in run_stages(Run.open(tmp_path / "undisturbed"), STAGES)]
    for moment in itertools.count(1, 5):  # every fifth: all of them stand in test_artifact, for one stage
        shutil.copytree(first.path, tmp_path / f"run{moment}")
        run = Run.open(tmp_path / f"run{moment}")
        killed = run_and_kill(lambda run=run: run_stages(run, STAGES), moment)  # type: ignore[misc]
        survey(STAGES, run)
        assert [outcome.digest for outcome in run_stages(run, STAGES)] == expected
        assert os.listdir(run.path / artifact.WORK) == []
        verify(run, STAGES)
        if not killed:
            break
    assert moment > 50


def test_another_executor(run: Run) -> None:
    asked = []

    def execute(stage: Stage, job: Job) -> Usage:
        asked.append(stage.name)
        local.execute(stage, job)
        return Usage(12.5, 99)

    run_stages(run, STAGES, execute=execute)
    assert asked == ["list", "count", "double", "report"]
    assert read_manifest(run.folder("count")).seconds == 12.5


def test_verify_reads_everything_and_lists_what_is_damaged(run: Run) -> None:
    assert verify(run, STAGES) == []
    run_stages(run, STAGES)
    assert set(actions(verify(run, STAGES)).values()) == {"verified"}
    run_stages(run, STAGES)  # all files are now known by size, time and inode
    path = run.folder("double") / "double.txt"
    status = path.stat()
    with open(path, "r+b") as file:
        file.write(b"X")
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
    (run.folder("list") / "images" / "0.jpg").unlink()
    (run.folder("report") / "extra.txt").write_text("")
    (run.folder("count") / "manifest.json").write_text("")
    events = Events()
    with pytest.raises(CorruptArtifact, match=run.how_to_resume()) as caught:
        verify(run, STAGES, events)
    assert caught.value.files == ("list/images/0.jpg", "count/manifest.json", "double/double.txt")
    assert ["extra.txt"] in [event.get("extra") for event in events.named("warning")]
    assert actions(run_stages(run, STAGES))["count"] == "ran"
    run_stages(run, STAGES, only="double", force=True)
    verify(run, STAGES)


def test_settings_that_cannot_work_are_refused_before_the_first_stage_runs(run: Run) -> None:
    asked: list[dict[str, object]] = []

    def refuse(settings: Mapping[str, object]) -> None:
        asked.append(dict(settings))
        raise UsageError("double cannot work with count")

    def refused(**selection: Any) -> None:
        with pytest.raises(UsageError, match="double cannot work"):
            run_stages(run, stages, **selection)

    stages = replaced("double", check=refuse)
    refused()
    refused(dry_run=True)
    assert not run.folder("list").exists()
    assert set(asked[0]) == {stage.name for stage in stages}
    assert type(asked[0]["count"]) is COUNT.settings
    # Not where it is not to run, or is up to date; but where what it needs is to run again.
    assert actions(run_stages(run, stages, until="count")) == {"list": "ran", "count": "ran"}
    run_stages(run, STAGES)
    assert set(actions(run_stages(run, stages)).values()) == {"skipped"}
    set_one(run, "count", steps=9)
    refused()
    refused(only="double", force=True)
    assert set(asked[-1]) == {"double"}
