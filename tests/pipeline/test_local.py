"""What the executor measures of a stage: processor time of the process and of its children."""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from pipeline.executors import local
from pipeline.stage import Job, Stage

BURN = "import time\nstarted = time.process_time()\nwhile time.process_time() - started < 0.3: pass"


@dataclass(frozen=True)
class NoSettings:
    pass


def here(job: Job) -> None:
    exec(BURN)


def in_a_child(job: Job) -> None:
    subprocess.run([sys.executable, "-c", BURN], check=True)


def idle(job: Job) -> None:
    time.sleep(0.3)


@pytest.mark.parametrize("work", [here, in_a_child])
def test_processor_time_is_that_of_the_process_and_its_children(tmp_path: Path, work: object) -> None:
    usage = local.execute(Stage("toy", 1, NoSettings, (), work), Job(settings=NoSettings(), out=tmp_path / "out", work=tmp_path / "work"))  # type: ignore[arg-type]
    assert usage.seconds >= 0.28
    assert 0.28 <= usage.cpu_seconds < 1.5
    assert usage.cores >= 1


def large_child(job: Job) -> None:
    subprocess.run([sys.executable, "-c", f"x = bytes(range(256)) * {2**22}"], check=True)


def test_the_memory_of_a_child_counts(tmp_path: Path) -> None:
    usage = local.execute(Stage("toy", 1, NoSettings, (), large_child), Job(settings=NoSettings(), out=tmp_path / "out", work=tmp_path / "work"))
    assert usage.peak_memory > 2**30


def test_waiting_is_not_busy(tmp_path: Path) -> None:
    usage = local.execute(Stage("toy", 1, NoSettings, (), idle), Job(settings=NoSettings(), out=tmp_path / "out", work=tmp_path / "work"))
    assert usage.cpu_seconds < 0.2 < usage.seconds
