"""Notes of pieces of work: what counts is as it was written, whatever lies there."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import pytest

from stages.scratch import note, noted, opened


@dataclass(frozen=True)
class Thing:
    name: str
    size: Annotated[int, msgspec.Meta(ge=1, le=2**20)]


def left(folder: Path) -> Path:
    (folder / "parts").mkdir()
    (folder / "parts" / "a.bin").write_bytes(b"0123456789")
    note(folder / "thing.json", {"name": "\udcff", "size": 3}, [folder / "parts" / "a.bin"])
    return folder / "thing.json"


def read(path: Path) -> tuple[Thing | None, list[str]]:
    said: list[str] = []
    return noted(path, Thing, said.append), said


def test_a_note_cut_or_zeroed_anywhere_does_not_count(tmp_path: Path) -> None:
    path = left(tmp_path)
    data = path.read_bytes()
    for length in range(len(data)):
        for damaged in (data[:length], data[:length] + b"\0" * (len(data) - length)):
            path.write_bytes(damaged)
            found, said = read(path)
            assert found is None
            assert len(said) == 1
            assert "thing.json of an earlier attempt can't be used" in said[0]
            assert not path.exists()


@pytest.mark.parametrize("damage", [b"", b"0123", b"\0" * 10, b"0123456788", None])
def test_a_file_that_is_not_as_it_was_written(tmp_path: Path, damage: bytes | None) -> None:
    path = left(tmp_path)
    output = tmp_path / "parts" / "a.bin"
    output.unlink()
    if damage is not None:
        output.write_bytes(damage)
    found, said = read(path)
    assert found is None
    assert len(said) == 1


def test_a_pipe_or_a_link_is_neither_waited_for_nor_followed(tmp_path: Path) -> None:
    path = left(tmp_path)
    output = tmp_path / "parts" / "a.bin"
    output.rename(tmp_path / "elsewhere")
    output.symlink_to(tmp_path / "elsewhere")
    assert read(path)[0] is None
    path = tmp_path / "pipe.json"
    os.mkfifo(path)
    with pytest.raises(OSError, match="is a pipe, expected a plain file"):
        opened(path)
    assert (tmp_path / "elsewhere").read_bytes() == b"0123456789"


@pytest.mark.parametrize(
    "value",
    [
        None,
        [],
        {},
        {"name": 1, "size": 3},
        {"name": "a", "size": 0},
        {"name": "a", "size": -1},
        {"name": "a", "size": 1.5},
        {"name": "a", "size": 10**400},
        "x",
    ],
)
def test_odd_values_with_the_right_checksum(tmp_path: Path, value: Any) -> None:
    note(tmp_path / "thing.json", value)
    found, said = read(tmp_path / "thing.json")
    assert found is None
    assert len(said) == 1
    assert len(said[0]) < 400
