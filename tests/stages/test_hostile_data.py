"""Every hostile input of tests/stages/hostile.py is answered as stated there."""

import contextlib
import re
import warnings
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest

from benchmarks.fuzz.reader import Opened, Outcome, judged
from benchmarks.fuzz.table import READERS
from tests.stages.hostile import FILES, FOLDER, MADE, READ

# NumPy leaves a file that begins as a zip, and is none, to the garbage collector.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


@cache
def _opened(reader: str, folder: Path) -> Opened:
    opened = READERS[reader].open(folder)
    with contextlib.suppress(Exception):
        opened.read(READERS[reader].seeds()[0])  # imports what it needs, for which there is no limit of time
    return opened


@pytest.fixture(scope="module")
def answer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str, bytes], Outcome]]:
    """The answer of a reader to an input; readers are opened once."""
    folders: dict[str, Path] = {}

    def call(reader: str, data: bytes) -> Outcome:
        folder = folders.setdefault(reader, tmp_path_factory.mktemp(reader, numbered=False) if reader not in folders else folders[reader])
        opened = _opened(reader, folder)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return judged(lambda: opened.read(data), READERS[reader].refusals)

    yield call
    _opened.cache_clear()


def check(outcome: Outcome, says: str) -> None:
    assert outcome.kind == ("accepted" if says == READ else "refused"), f"{outcome.by}: {outcome.text}\n{outcome.trace}"
    if says != READ:
        assert re.search(says, outcome.text), outcome.text


@pytest.mark.parametrize(("reader", "name"), [(reader, name) for reader, names in FILES.items() for name in names])
def test_a_hostile_file_is_answered(reader: str, name: str, answer: Callable[[str, bytes], Outcome]) -> None:
    check(answer(reader, (FOLDER / reader / name).read_bytes()), FILES[reader][name])


@pytest.mark.parametrize(("reader", "name"), MADE)
def test_a_hostile_input_is_answered(reader: str, name: str, answer: Callable[[str, bytes], Outcome]) -> None:
    make, says = MADE[reader, name]
    check(answer(reader, make()), says)


def test_every_file_has_its_answer_and_all_are_small() -> None:
    there = {(path.parent.name, path.name) for path in FOLDER.rglob("*") if path.is_file()}
    assert there == {(reader, name) for reader, names in FILES.items() for name in names}
    assert sum(path.stat().st_size for path in FOLDER.rglob("*") if path.is_file()) < 200_000
