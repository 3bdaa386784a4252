"""The collector of garbage looks once at what stages leave behind, in a process that is theirs."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.executors.local import execute, execute_alone
from pipeline.stage import Job, Stage
from tests.pipeline.toy import NoSettings


class Knot:
    """Garbage that only the collector finds."""

    def __init__(self) -> None:
        self.own = self


@pytest.fixture(autouse=True)
def thawed() -> Iterator[None]:
    gc.collect()
    gc.freeze()  # what other tests left stays out of it
    yield
    gc.unfreeze()
    gc.freeze()


def test_a_stage_begins_without_garbage_and_former_objects_are_frozen(tmp_path: Path) -> None:
    kept = [[number] for number in range(1000)]
    garbage = weakref.ref(Knot())
    before, seen = gc.get_freeze_count(), []

    def run(job: Job) -> None:
        seen.append((gc.get_freeze_count(), garbage()))

    stage = Stage("toy", 1, NoSettings, (), run)
    job = Job(settings=None, inputs={}, out=tmp_path / "out", work=tmp_path / "work")
    execute(stage, job)
    assert seen == [(before, None)]
    garbage = weakref.ref(Knot())
    execute_alone(stage, job)
    assert seen[1][0] >= before + len(kept)
    assert seen[1][1] is None
