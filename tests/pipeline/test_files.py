import errno
import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipeline import files
from pipeline.errors import DiskFull
from pipeline.failures import translated


@pytest.mark.parametrize("name", ["a", "a/b.txt", "images/0 1.jpg", "..a", "a..", ".hidden", "a\\b"])
def test_names_that_stay(name: str) -> None:
    assert files.is_safe_name(name)


@pytest.mark.parametrize("name", ["", ".", "..", "/a", "//a", "../a", "a/../b", "a/..", "a//b", "a/", "./a", "a/./b", "a\0b"])
def test_names_that_leave_or_are_not_the_only_spelling(name: str) -> None:
    assert not files.is_safe_name(name)


@pytest.mark.parametrize(
    "data",
    [b"", b"{", b"\xff\xfe", b"[NaN]", b"[" * 100_000, b"1" * 5000, b" " * 30000, b"[1e999]", b"[" * 101 + b"]" * 101, b"[" + b"[]," * 2**21 + b"[]]"],
    ids=range(10),
)
def test_json_from_anybody(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(data)
    with pytest.raises(files.Unreadable) as caught:
        files.read_json(path, limit=20_000_000 if data.startswith(b"[[") else 20_000)
    assert "\n" not in str(caught.value)
    with pytest.raises(files.Unreadable):
        files.read_json(tmp_path)
    with pytest.raises(FileNotFoundError):
        files.read_json(tmp_path / "none.json")


def test_write_atomically_replaces_and_leaves_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    for value in ({}, {"b": (1, 2.0), "a": "é"}):
        files.write_atomically(path, files.canonical_json(value))
    assert path.read_bytes() == b'{"a":"\\u00e9","b":[1,2.0]}'
    assert os.listdir(tmp_path) == ["a.json"]
    with pytest.raises(ValueError, match="JSON"):
        files.canonical_json(float("inf"))


def test_links_are_named_or_removed_and_not_followed(tmp_path: Path) -> None:
    (tmp_path / "in" / "sub").mkdir(parents=True)
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "secret").write_text("x")
    (tmp_path / "in" / "a").write_text("x")
    (tmp_path / "in" / "sub" / "b").write_text("x")
    (tmp_path / "in" / "link").symlink_to(tmp_path / "outside")
    assert sorted(name for name, _ in files.walk(tmp_path / "in")) == ["a", "link", "sub/b"]
    for name in ("link", "none"):
        files.discard(tmp_path / "in" / name, tmp_path)
    assert sorted(os.listdir(tmp_path / "in")) == ["a", "sub"]
    assert os.listdir(tmp_path / "outside") == ["secret"]


@pytest.mark.parametrize("error", [OSError("1501528 requested and 475104 written"), RuntimeError("encoder error -2"), ValueError()])
@pytest.mark.parametrize("together", [False, True])
def test_the_error_of_a_library_that_drops_its_number_is_a_full_disk_where_nothing_is_free(
    error: Exception, together: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Looked at before what was written is removed: then there is room again."""

    def disk_usage(folder: Path) -> SimpleNamespace:
        return SimpleNamespace(free=0 if any(path.stat().st_size for path in tmp_path.iterdir()) else 2**30)

    def write(error: Exception) -> None:
        with files.atomic_together([tmp_path / "b", tmp_path / "a"]) if together else files.atomic(tmp_path / "a") as found:
            (found[0] if isinstance(found, list) else found).write_bytes(b"half")
            raise error

    with pytest.raises(type(error)) as caught:
        write(error)
    assert caught.value is error
    monkeypatch.setattr(files.shutil, "disk_usage", disk_usage)
    with pytest.raises(OSError, match=os.strerror(errno.ENOSPC)) as full:
        write(error)
    assert full.value.errno == errno.ENOSPC
    assert isinstance(translated(full.value, "bake", tmp_path), DiskFull)
    assert not any(tmp_path.iterdir())
    with pytest.raises(PermissionError):
        write(PermissionError(errno.EACCES, "denied"))
