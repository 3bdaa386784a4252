"""The short form of `make fuzz`: two hundred inputs to each reader, read or refused in the documented way."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from random import Random

import pytest

from benchmarks.fuzz import worker
from benchmarks.fuzz.binary import changed_bytes
from benchmarks.fuzz.reader import LIMIT, Hang, commanded, judged
from benchmarks.fuzz.shrinking import shrunk
from benchmarks.fuzz.table import READERS
from pipeline.errors import BadInput

INPUTS = 80
# NumPy leaves a file that begins as a zip, and is none, to the garbage collector.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


@pytest.fixture(autouse=True)
def _no_warnings_of_libraries() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@pytest.mark.parametrize("name", READERS)
def test_a_reader_reads_or_refuses_what_is_changed_at_random(name: str, tmp_path: Path) -> None:
    tally = worker.opened_reader(name, tmp_path, 1)
    inputs = round(INPUTS * READERS[name].share)
    worker.plainly(tally, 1, inputs)
    assert [(found["by"], found["place"], found["text"], bytes.fromhex(found["data"])) for found in tally.findings.values()] == []
    assert tally.inputs == inputs
    assert tally.slowest < LIMIT


def test_the_same_seed_gives_the_same_inputs_within_their_place() -> None:
    for reader in READERS.values():
        seed = reader.seeds()[0]
        some, again = ([worker.changed(reader, worker.random_of(7, index), seed) for index in range(20)] for _ in range(2))
        assert some == again
        assert len({*some}) > 5
    assert all(changed_bytes(Random(seed), bytes(100), begin=40)[:40] == bytes(40) for seed in range(50))
    assert shrunk(b'{"a": [1, 2, {"b": "bad"}], "c": "long text"}', lambda data: b"bad" in data, 1.0) == b"bad"


def test_outcomes_are_told_apart() -> None:
    def fails(error: BaseException) -> None:
        raise error

    assert judged(lambda: None, ()).kind == "accepted"
    assert judged(lambda: fails(BadInput("a.json: is wrong.")), ("PipelineError",)).kind == "refused"
    assert judged(lambda: fails(KeyError("x")), ("PipelineError",)).by == "KeyError"
    assert judged(lambda: fails(BadInput("x" * 2000)), ("PipelineError",)).by == "BadInput, a message that is too long"
    assert judged(lambda: fails(Hang("more than 5 s")), ("Exception",)).kind == "finding"
    assert commanded(("status", "/nowhere")).by == "exit code 2"
