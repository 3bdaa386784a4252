"""Short forms of `make torture` and `make faults`: toy stages in a blink, real ones where there is time."""

import errno
import json
import multiprocessing
import signal
from dataclasses import replace
from pathlib import Path

import numba
import pytest
from numba.np.ufunc import parallel

from benchmarks.torture import preparation, processes, trap
from benchmarks.torture.cases import NEW, Case, Cases
from benchmarks.torture.comparison import Expected, digests, names
from benchmarks.torture.kills import Prepared, Rounds
from benchmarks.torture.sources import Source
from benchmarks.torture.trap import Armed, Trap
from tests.workflows.torment import torment
from tests.workflows.toys import TOYS
from workflows.workflow import Workflow

STAGES = tuple(stage.name for stage in TOYS)


@pytest.fixture
def toy(toys: Path, tmp_path: Path) -> tuple[Prepared, Workflow]:
    """The undisturbed run of the toy workflow, and one with other artifacts."""
    workflow = Workflow(TOYS, toys.parent / "presets")
    source = Source("toy", toys, ("--preset", "tiny", "--device", "cpu", "--set", "train.iterations=40"))
    place = tmp_path / "undisturbed"
    place.mkdir()
    armed = Armed(Trap(), place / "run", toys, place / "state", place / "log")
    for run, more, watch in (("run", (), armed), ("older", ("--set", "poses.repeat=2"), None)):
        child = processes.start(source.arguments(place / run, *more), place / "errors", watch, workflow=workflow)
        assert child.end() == 0, child.errors
    wanted = Expected(digests(place / "run", STAGES), names(place / "run"))
    return Prepared(source, wanted, child.seconds, trap.operations(place / "log"), place / "older"), workflow


def test_killed_and_signalled_toy_runs_end_in_the_same_artifacts(toy: tuple[Prepared, Workflow], tmp_path: Path) -> None:
    prepared, workflow = toy
    with (tmp_path / "book").open("w") as book:
        rounds = Rounds(tmp_path / "rounds", [prepared], 5, book, workflow=workflow)
        for number in range(20):  # a quick run has ended before most of its moments
            if number >= 2 and rounds.kills >= 4:
                break
            assert rounds.round(prepared) == []
    hits = [line for line in map(json.loads, (tmp_path / "book").read_text().splitlines()) if line["event"] == "hit"]
    assert [hit for hit in hits if hit["wrong"]] == []
    assert {hit["moment"] for hit in hits} == {"time", "call"}
    assert rounds.kills >= 4


def test_a_hung_run_is_ended_and_shows_where_it_was(toy: tuple[Prepared, Workflow], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prepared, workflow = toy
    monkeypatch.setattr(processes, "LIMIT", 2.0)
    child = processes.start(prepared.source.arguments(tmp_path / "run", "--set", "train.fail=slow"), tmp_path / "errors", workflow=workflow)
    assert child.end() == -signal.SIGKILL
    assert "hung: not done after 2 s" in child.errors
    assert "in _wait_for" in child.errors


def test_a_run_waits_for_no_lock_of_one_that_was_killed(toys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """numba's is a semaphore that forked processes share."""
    numba.get_num_threads()
    monkeypatch.setattr(processes, "LIMIT", 20.0)
    monkeypatch.setattr(parallel, "_backend_init_process_lock", multiprocessing.get_context().RLock())
    assert preparation.wait_for([processes.forked(lambda: parallel._backend_init_process_lock.acquire() and None)]) == 0  # ends with it
    stage = replace(TOYS[0], run=lambda job: (job.out / "text.txt").write_text(f"{numba.get_num_threads()}\n", encoding="utf-8"))
    source = Source("toy", toys, ("--preset", "tiny", "--device", "cpu"))
    child = processes.start(source.arguments(tmp_path / "run"), tmp_path / "errors", workflow=Workflow((stage, *TOYS[1:]), toys.parent / "presets"))
    assert child.end() == 0, child.errors


FAULTS = (
    ("engine", "mkdir", 1, errno.EROFS, True),
    ("engine", "open", 1, errno.EACCES, False),
    ("source", "read", 1, errno.EIO, False),
    ("train", "mkdir", 2, errno.ENOSPC, False),
    ("train", "open", 1, errno.EMFILE, True),
    ("train", "write", 1, errno.ENOSPC, False),
    ("points", "fsync", 1, errno.EIO, True),
    ("points", "rename", 1, errno.EROFS, False),
)


def test_failing_operations_of_toy_runs_lose_nothing(toy: tuple[Prepared, Workflow], tmp_path: Path) -> None:
    prepared, workflow = toy
    with (tmp_path / "book").open("w") as book:
        cases = Cases(tmp_path / "cases", [prepared], book, workflow=workflow)
        for where, *operation in FAULTS:
            assert cases.carry_out(Case("toy", where if where in STAGES else NEW, where, *operation)) == []
    assert all(json.loads(line)["reached"] for line in (tmp_path / "book").read_text().splitlines())


@pytest.mark.slow
@pytest.mark.timeout(1800)  # a minute of a core, on a machine that may be very busy
def test_killed_runs_end_in_the_same_artifacts(tmp_path: Path) -> None:
    result = torment(tmp_path, "benchmarks.torture", "--kills", "12", "--sources", "llff")
    assert result["kills"] >= 12
    assert len(result["kills_per_stage"]) >= 2
