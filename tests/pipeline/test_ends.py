"""How a run ends: the error that ended it is the one that is reported, what it leaves is used or goes, and the advice leads on."""

import contextlib
import errno
import itertools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import filelock
import pytest

from pipeline import artifact, files
from pipeline.errors import BadInput, DiskFull, Interrupted, PipelineError, StageFailed
from pipeline.locks.lock import HOLDER
from pipeline.manifest import read_manifest
from pipeline.run import Run
from pipeline.runner import run_stages, verify
from tests.pipeline.toy import STAGES, Events, actions, make_run, raising, replaced


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return make_run(tmp_path)


def failing(step: Callable[..., Any], number: int, when: Callable[..., bool] = lambda *arguments: True) -> Callable[..., Any]:
    def call(*arguments: Any, **more: Any) -> Any:
        if when(*arguments):
            raise OSError(number, os.strerror(number), str(arguments[0]))
        return step(*arguments, **more)

    return call


def counted(step: Callable[..., Any], left: list[int], *, late: bool = True) -> Callable[..., Any]:
    """A step of which the last that is left fails: `late`, when what it does is done, as where a disk says so too late; else before."""

    def call(*arguments: Any) -> None:
        left[0] -= 1
        if late or left[0] != 0:
            step(*arguments)
        if left[0] == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    return call


@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC])
def test_clearing_up_the_lock_hides_no_error(run: Run, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    monkeypatch.setattr(Path, "unlink", failing(Path.unlink, number, lambda path, *rest: path.name == HOLDER))
    monkeypatch.setattr(filelock.FileLock, "release", counted(filelock.FileLock.release, [1]))
    with pytest.raises(StageFailed, match="the real one"):
        run_stages(run, replaced("count", run=raising(ValueError("the real one"))))
    assert set(actions(run_stages(Run.open(run.path), STAGES[:1])).values()) == {"skipped"}  # and none where all went well


@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC])
def test_nothing_that_is_done_last_hides_the_error_of_a_stage(run: Run, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    def break_the_disk(job: object) -> None:
        for name in ("rename", "sync_folder", "remove"):
            monkeypatch.setattr(files, name, failing(getattr(files, name), number))
        raise ValueError("the real one")

    with pytest.raises(StageFailed, match="the real one"):
        run_stages(run, replaced("count", run=break_the_disk), report=failing(print, errno.ENOSPC, lambda event: event["event"] == "stage_failed"))
    monkeypatch.undo()
    assert actions(run_stages(run, STAGES))["report"] == "ran"
    assert os.listdir(run.path / artifact.WORK) == []


@pytest.mark.parametrize(("number", "kind", "code"), [(errno.EIO, StageFailed, 3), (errno.ENOSPC, DiskFull, 3), (errno.EACCES, BadInput, 2)])
def test_failures_outside_of_stages_have_a_code(run: Run, monkeypatch: pytest.MonkeyPatch, number: int, kind: type[PipelineError], code: int) -> None:
    run_stages(run, STAGES)
    (run.path / artifact.WORK / "trash-1-1").mkdir()
    monkeypatch.setattr(files, "remove", failing(files.remove, number))
    with pytest.raises(kind) as caught:
        run_stages(run, STAGES)
    assert (type(caught.value), caught.value.exit_code) == (kind, code)
    monkeypatch.undo()
    for name in ("manifest.json", "count.txt"):  # too many open files make no artifact corrupt
        monkeypatch.setattr(os, "open", failing(os.open, errno.EMFILE, lambda path, *rest, name=name: str(path).endswith(f"count/{name}")))
        with pytest.raises(StageFailed):
            run_stages(run, STAGES)
        monkeypatch.undo()
    assert set(actions(run_stages(run, STAGES)).values()) == {"skipped"}


@pytest.mark.parametrize("late", [False, True])
def test_an_error_behind_any_step_of_publishing_leaves_nothing_for_ever(run: Run, monkeypatch: pytest.MonkeyPatch, *, late: bool) -> None:
    """At each sync and rename: the former artifact, or the new one, stands."""
    run_stages(run, STAGES)
    for moment in itertools.count(1):
        left = [moment]
        for name in ("rename", "sync_folder", "sync_file"):
            monkeypatch.setattr(files, name, counted(getattr(files, name), left, late=late))
        with contextlib.suppress(StageFailed):
            run_stages(run, STAGES, only="count", force=True)
        monkeypatch.undo()
        made = read_manifest(run.folder("count"))
        assert not artifact.differences(run.folder("count"), made.outputs).damaged
        run_stages(run, STAGES)
        assert os.listdir(run.path / artifact.WORK) == []
        verify(run, STAGES)
        if left[0] > 0:
            break
    assert moment > 10


def test_an_interruption_of_forced_stages_says_how_to_go_on_with_them(run: Run) -> None:
    def advice(stage: str, **selection: Any) -> str:
        events = Events()
        with pytest.raises(Interrupted):
            run_stages(run, replaced(stage, run=raising(KeyboardInterrupt())), report=events, **selection)
        return str(events.named("interrupted")[0]["resume"])

    assert advice("list", start="double") == run.how_to_resume(start="double")
    assert advice("count", until="double") == run.how_to_resume(until="double")
    run_stages(run, STAGES)
    assert advice("double", start="count") == run.how_to_resume(start="double") == f"run the stages from double of {run.path}"
    assert advice("double", start="count", until="double") == run.how_to_resume(start="double", until="double")
    assert advice("count", force=True) == run.how_to_resume(start="count")
    assert advice("count", only="count", force=True) == run.how_to_resume(only="count", force=True)
    with pytest.raises(Interrupted):
        run_stages(run, replaced("double", run=raising(KeyboardInterrupt())), start="count")
    assert actions(run_stages(run, STAGES, start="double")) == {"list": "skipped", "count": "skipped", "double": "ran", "report": "ran"}
