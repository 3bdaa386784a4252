"""The short form of `make fuzz`: two hundred inputs to each reader, read or refused in the documented way."""

import warnings
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.fuzz import worker
from benchmarks.fuzz.reader import LIMIT
from benchmarks.fuzz.table import READERS

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
