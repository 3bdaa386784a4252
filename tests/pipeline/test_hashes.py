import hashlib
import os
import time
from pathlib import Path

import pytest

from pipeline.errors import Interrupted
from pipeline.hashes import Hashes


def old_file(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    os.utime(path, ns=(10**18, 10**18))
    return path


@pytest.fixture
def later(monkeypatch: pytest.MonkeyPatch) -> None:
    """Some seconds after all files of the test were written."""
    monkeypatch.setattr("pipeline.hashes.SETTLED_NS", -10_000_000_000)


def test_a_known_file_is_not_read_again(tmp_path: Path, later: None, monkeypatch: pytest.MonkeyPatch) -> None:
    def stop() -> None:
        raise Interrupted()

    path, cache = old_file(tmp_path / "a", b"one"), tmp_path / "cache" / "h.json"
    hashes = Hashes(cache)
    first = hashes.digest("k", path)
    assert first == hashlib.sha256(b"one").hexdigest()
    hashes.save()
    with pytest.raises(Interrupted):
        Hashes(safe_point=stop).digest("k", path)
    unwritable = Hashes(path / "h.json")
    unwritable.digest("k", path)
    unwritable.save()  # does no harm

    monkeypatch.setattr("pipeline.hashes.sha256_of", lambda *arguments, **more: "read")
    assert Hashes(cache).digest("k", path) == first
    assert Hashes(cache).digest("k", path, anew=True) == "read"


def test_a_file_whose_time_was_set_back_is_read_again(tmp_path: Path, later: None) -> None:
    """The same inode, size and time of modification; that of the change of its status nobody can set."""
    path = old_file(tmp_path / "a", b"one")
    hashes = Hashes()
    hashes.digest("k", path)
    time.sleep(0.02)  # a tick
    with open(path, "r+b") as file:
        file.write(b"two")
    os.utime(path, ns=(10**18, 10**18))
    assert hashes.digest("k", path) == hashlib.sha256(b"two").hexdigest()


@pytest.mark.parametrize("age", [1.9, 2.2])
def test_only_what_is_older_than_two_seconds_is_remembered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, age: float) -> None:
    """A file system may have ticks of two seconds: what is written twice within one keeps its times."""
    path = tmp_path / "a"
    path.write_bytes(b"one")
    written = max(path.stat().st_mtime_ns, path.stat().st_ctime_ns)
    monkeypatch.setattr("pipeline.hashes.time.time_ns", lambda: written + int(age * 1e9))
    hashes = Hashes()
    hashes.digest("k", path)
    assert bool(hashes._entries) == (age > 2)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": "other", "files": {}}', '{"format": "enerf-hashes-1", "files": {"k": [1, 2, 3, "x"], "l": 5}}'])
def test_a_damaged_memory_is_ignored(tmp_path: Path, text: str) -> None:
    cache = tmp_path / "h.json"
    cache.write_text(text)
    path = old_file(tmp_path / "a", b"one")
    assert Hashes(cache).digest("k", path) == hashlib.sha256(b"one").hexdigest()
