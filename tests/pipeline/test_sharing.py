"""Runs that share an artifact: each is whole by itself, whatever becomes of the other, and at whatever moment the sharing is killed."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from pipeline.artifact import WORK
from pipeline.decide import decide, survey
from pipeline.errors import CorruptArtifact, RunLocked
from pipeline.locks.lock import lock
from pipeline.manifest import read_manifest
from pipeline.run import Run
from pipeline.runner import run_stages, verify
from pipeline.sharing import take_over
from tests.pipeline.kills import run_and_kill
from tests.pipeline.toy import LIST, STAGES, actions, make_run, set_one


@pytest.fixture
def donor(tmp_path: Path) -> Run:
    run = make_run(tmp_path / "first")
    run_stages(run, STAGES)
    return run


@pytest.fixture
def other(tmp_path: Path, donor: Run) -> Run:
    """A run of the same photographs that has yet to begin, of which the stage count has another setting."""
    run = Run.create(tmp_path / "second" / "run", donor.source, donor.settings)
    set_one(run, "count", steps=9)
    return run


def test_the_same_request_is_the_same_artifact(donor: Run, other: Run) -> None:
    assert take_over(other, LIST, donor.path)
    assert decide(LIST, other).fresh
    assert os.path.samefile(other.folder("list") / "images" / "0.jpg", donor.folder("list") / "images" / "0.jpg")
    assert read_manifest(other.folder("list")) == read_manifest(donor.folder("list"))
    assert actions(run_stages(other, STAGES)) == {"list": "skipped", "count": "ran", "double": "ran", "report": "ran"}
    verify(other, STAGES)
    verify(donor, STAGES)
    assert not (other.path / WORK / "list").exists()


@pytest.mark.parametrize("damage", [lambda path: path.write_bytes(b"y"), lambda path: path.write_bytes(b"longer"), Path.unlink])
def test_a_damaged_artifact_is_not_taken(donor: Run, other: Run, damage: Callable[[Path], object], tmp_path: Path) -> None:
    damage(donor.folder("list") / "images" / "0.jpg")
    assert not take_over(other, LIST, donor.path)
    (donor.folder("list") / "manifest.json").write_text("{}")
    assert not take_over(other, LIST, donor.path)
    assert not take_over(other, LIST, tmp_path / "nowhere")
    assert not other.folder("list").exists()
    assert actions(run_stages(other, STAGES))["list"] == "ran"
    verify(other, STAGES)


def test_a_donor_that_leads_elsewhere_is_refused(donor: Run, other: Run, tmp_path: Path) -> None:
    with lock(other.path), pytest.raises(RunLocked):  # so is a run that is being written
        take_over(Run.open(other.path), LIST, donor.path)
    path = donor.folder("list") / "images" / "0.jpg"
    path.rename(tmp_path / "secret")
    path.symlink_to(tmp_path / "secret")
    with pytest.raises(CorruptArtifact):
        take_over(other, LIST, donor.path)


def test_kills_at_every_moment_of_taking_over(donor: Run, other: Run) -> None:
    """An artifact of before stands in its place; then the one of the present settings does."""
    set_one(donor, "list", upper=True)
    run_stages(donor, STAGES)
    run_stages(other, [LIST])
    set_one(other, "list", upper=True)
    moment = 0
    while run_and_kill(lambda: take_over(Run.open(other.path), LIST, donor.path), moment := moment + 1):
        run = Run.open(other.path)
        assert next(each.state for each in survey([LIST], run)) in ("fresh", "stale", "partial")
        take_over(run, LIST, donor.path)
        assert decide(LIST, run).fresh
        verify(run, STAGES)
        set_one(run, "list", upper=False)
        run_stages(run, [LIST])
        set_one(run, "list", upper=True)
    assert moment > 8
    assert list((other.path / WORK).iterdir()) == []


def test_shared_artifacts_are_replaced_at_every_moment(donor: Run, other: Run) -> None:
    """What is set aside or thrown away has a second name, which is no reason to refuse a run that was killed then."""
    moment, killed = 0, True
    while killed:
        moment += 1
        assert take_over(other, LIST, donor.path)
        set_one(other, "list", upper=True)
        killed = run_and_kill(lambda path=other.path: run_stages(Run.open(path), [LIST]), moment)
        other = Run.open(other.path)
        run_stages(other, [LIST])
        verify(other, [LIST])
        set_one(other, "list", upper=False)
    assert moment > 8
    verify(donor, STAGES)
