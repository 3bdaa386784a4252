"""Short forms of `make torture` and `make faults`: toy stages in a blink, real ones where there is time."""

import errno
import json
from pathlib import Path

import pytest

from benchmarks.torture import processes, trap
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
