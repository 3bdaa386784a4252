"""Stages that do not need each other run at the same time, each in a process of its own, and make what they make one after another."""

import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pipeline.errors import BadInput, CorruptArtifact, Interrupted, PipelineError, StageFailed, TooLittleMemory
from pipeline.executors.memory import Limit
from pipeline.executors.side_by_side import FailureInChild, SideBySide
from pipeline.manifest import read_manifest
from pipeline.runner import Outcome, run_stages
from tests.pipeline.diamond import AFTER_LEFT, MIDDLE, STAGES, make_run
from tests.pipeline.toy import Events, actions, contents

CHILD = "tests.pipeline.diamond"
pytestmark = pytest.mark.skipif(os.name != "posix", reason="children are POSIX's")


def side_by_side(jobs: int = 2, cores: int = 4, need: Callable[[Any], int | None] = lambda stage: 1) -> SideBySide:
    return SideBySide(CHILD, jobs, cores, need)


def done(run: Any, jobs: int = 2, **how: Any) -> list[Outcome]:
    with side_by_side(jobs) as together:
        return run_stages(run, STAGES, side_by_side=together, **how)


def test_they_run_at_the_same_time_and_the_artifacts_are_the_same(tmp_path: Path) -> None:
    place = tmp_path / "place"
    place.mkdir()
    events = Events()
    run = make_run(tmp_path / "run", place=place, meets={"left": ("right", "centre"), "right": ("left", "centre"), "centre": ("left", "right")})
    outcomes = done(run, 3, report=events)
    assert [outcome.stage for outcome in outcomes] == [stage.name for stage in STAGES]
    processes = {name: (place / name).read_text().split() for name in MIDDLE}
    assert len({pid for pid, _ in processes.values()} - {str(os.getpid())}) == 3
    assert {threads for _, threads in processes.values()} == {"4"}
    assert {event["stage"] for event in events.named("progress")} == {*MIDDLE}
    assert [event["stage"] for event in events.named("stage_done")][0::4] == ["top", "bottom"]
    alone = make_run(tmp_path / "alone")
    run_stages(alone, STAGES)
    made, expected = ({name: data for name, data in contents(folder.path).items() if name != "run.json"} for folder in (run, alone))
    assert made == expected
    assert actions(done(run)) == dict.fromkeys(actions(outcomes), "skipped")


def test_a_stage_begins_once_those_that_it_needs_have_ended_while_others_run(tmp_path: Path) -> None:
    place = tmp_path / "place"
    place.mkdir()
    run = make_run(tmp_path / "run", place=place, meets={"right": ("after_left",)})
    stages = [stage for stage in STAGES if stage.name in ("top", "left", "right")] + [AFTER_LEFT]
    with side_by_side(2) as together:
        outcomes = run_stages(run, stages, side_by_side=together)
    assert actions(outcomes) == {"top": "ran", "left": "ran", "right": "ran", "after_left": "ran"}


@pytest.mark.parametrize(
    ("does", "kind", "text"),
    [
        ("raises", StageFailed, "right: ValueError: a library's words"),
        ("bad input", BadInput, "no such thing. Give another."),
        ("corrupt", CorruptArtifact, "altered"),
        ("too little memory", TooLittleMemory, "needs more"),
        ("dies", StageFailed, "right: its process ended with exit code 9 and no answer."),
    ],
)
def test_what_a_stage_raises_is_raised_and_the_others_are_kept(tmp_path: Path, does: str, kind: type[PipelineError], text: str) -> None:
    events = Events()
    run = make_run(tmp_path / "run", does={"right": does})
    with pytest.raises(kind) as caught:
        done(run, 3, report=events)
    assert type(caught.value) is kind
    assert str(caught.value) == text
    assert getattr(caught.value, "needed", 123) == 123
    assert getattr(caught.value, "files", ("top/top.txt",)) == ("top/top.txt",)
    if does == "raises":
        assert isinstance(caught.value.__cause__, FailureInChild)
        assert "run_middle" in str(caught.value.__cause__)
    assert [event["stage"] for event in events.named("stage_failed")] == ["right"]
    assert run.folder("left").exists()
    assert not run.folder("right").exists()
    assert not run.folder("bottom").exists()
    settings = {**run.settings, "right": {**run.settings["right"], "does": "ends"}}
    run.update(settings=settings)
    found = actions(done(run))
    assert (found["left"], found["right"], found["bottom"]) == ("skipped", "ran", "ran")


def test_a_signal_stops_all_of_them_and_the_run_goes_on_later(tmp_path: Path) -> None:
    place = tmp_path / "place"
    place.mkdir()
    run = make_run(tmp_path / "run", place=place, does={"left": "waits", "right": "waits"})

    def interrupt() -> None:
        while not all(path.exists() for path in (place / "left", place / "right", run.folder("centre"))):
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGTERM)

    thread = threading.Thread(target=interrupt)
    thread.start()
    with pytest.raises(Interrupted) as caught:
        done(run, 3)
    thread.join()
    assert caught.value.number == signal.SIGTERM
    assert run.folder("centre").exists()
    assert not run.folder("left").exists()
    settings = {name: {**table, **({"does": "ends"} if name in MIDDLE else {})} for name, table in run.settings.items()}
    run.update(settings=settings)
    assert actions(done(run))["bottom"] == "ran"


@pytest.mark.parametrize(("need", "together"), [(50, True), (51, False), (None, False)])
def test_they_run_one_after_another_where_the_memory_is_too_little(tmp_path: Path, need: int | None, together: bool) -> None:
    (tmp_path / "place").mkdir()
    run = make_run(tmp_path / "run", place=tmp_path / "place")
    with side_by_side(2, need=lambda stage: need) as sides:
        run_stages(run, STAGES, side_by_side=sides, memory=Limit(100, "this machine"))
    ours = {(tmp_path / "place" / name).read_text().split()[0] == str(os.getpid()) for name in MIDDLE}
    assert ours == {not together}
    assert {read_manifest(run.folder(name)).facts["memory"] for name in MIDDLE} == {50 if together else 100}


@pytest.mark.parametrize("least", [0.0, 1e6])
def test_they_run_at_the_same_time_only_where_the_stages_before_took_long(tmp_path: Path, least: float) -> None:
    (tmp_path / "place").mkdir()
    run = make_run(tmp_path / "run", place=tmp_path / "place")
    with SideBySide(CHILD, 2, 2, lambda stage: 1, least) as sides:
        run_stages(run, STAGES, side_by_side=sides)
    ours = {(tmp_path / "place" / name).read_text().split()[0] == str(os.getpid()) for name in MIDDLE}
    assert ours == {least > 0}
