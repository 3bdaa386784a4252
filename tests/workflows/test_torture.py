"""Short forms of `make torture` and `make faults`: toy stages in a blink, real ones where there is time."""

from __future__ import annotations

import errno
import json
import shutil
import subprocess
import sys
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

ROOT = Path(__file__).resolve().parents[2]
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
        child = processes.start(source.arguments(place / run, *more), place / "errors", watch, watched_by_python=True, workflow=workflow)
        assert child.end() == 0, child.errors
    wanted = Expected(digests(place / "run", STAGES), names(place / "run"))
    return Prepared(source, wanted, child.seconds, trap.operations(place / "log"), place / "older"), workflow


def test_killed_and_signalled_toy_runs_end_in_the_same_artifacts(toy: tuple[Prepared, Workflow], tmp_path: Path) -> None:
    prepared, workflow = toy
    with (tmp_path / "book").open("w") as book:
        rounds = Rounds(tmp_path / "rounds", [prepared], 5, book, python_alone=True, workflow=workflow)
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
        cases = Cases(tmp_path / "cases", [prepared], book, python_alone=True, workflow=workflow)
        for where, *operation in FAULTS:
            assert cases.carry_out(Case("toy", where if where in STAGES else NEW, where, *operation)) == []
    assert all(json.loads(line)["reached"] for line in (tmp_path / "book").read_text().splitlines())


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_the_library_and_the_hooks_of_python_see_the_same_operations(tmp_path: Path) -> None:
    library = trap.build(tmp_path)
    assert library is not None
    program = """
import os, sys
from pathlib import Path
if sys.argv[2] == "python":
    from benchmarks.torture.audit import arm
    arm()
run = Path(sys.argv[1])
(run / "train").mkdir()
(run / "train" / "a").write_text("words")
os.rename(run / "train" / "a", run / "train" / "b")
descriptor = os.open(run / "train" / "b", os.O_RDONLY)
os.fsync(descriptor)
os.close(descriptor)
(run / "train" / "b").unlink()
(run / "train").rmdir()
(run / "run.json").write_bytes(b"{}")
"""
    seen = []
    for watcher in ("library", "python"):
        run = tmp_path / watcher
        run.mkdir()
        armed = Armed(Trap(), run, tmp_path / "source", tmp_path / "state", tmp_path / f"{watcher}.log")
        environment = processes.single_threaded_environment(library if watcher == "library" else None) | armed.environment
        subprocess.run([sys.executable, "-c", program, str(run), watcher], env=environment, check=True, cwd=ROOT)
        seen.append([(operation.stage, operation.kind, Path(operation.path).name) for operation in trap.operations(armed.log or run)])
    assert seen[0] == seen[1]
    assert [kind for _, kind, _ in seen[0]] == ["mkdir", "open", "write", "rename", "read", "fsync", "unlink", "rmdir", "open", "write"]


@pytest.mark.slow
@pytest.mark.timeout(1800)  # two minutes of a core, on a machine that may be very busy
def test_killed_runs_end_in_the_same_artifacts(tmp_path: Path) -> None:
    result = torment(tmp_path, "benchmarks.torture", "--kills", "30", "--sources", "photographs,llff")
    assert result["kills"] >= 30
    assert {"poses", "train"} <= set(result["kills_per_stage"])
