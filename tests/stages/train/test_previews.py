"""Previews: which of the scratch folder are published."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from stages.io.png import write_png
from stages.train import previews
from stages.train.previews import Previews


@pytest.fixture
def found(tmp_path: Path) -> Previews:
    """Two of an earlier attempt, of which one is cut short."""
    made = Previews.__new__(Previews)
    made.work = tmp_path / "work"
    made.work.mkdir()
    for step in (1, 2):
        write_png(np.zeros((4, 4, 3), np.uint8), made.work / f"preview_{step:06d}.png")
    (made.work / "preview_000002.png").write_bytes((made.work / "preview_000002.png").read_bytes()[:40])
    return made


def test_a_damaged_preview_is_left_out(found: Previews, tmp_path: Path) -> None:
    said: list[str] = []
    found.publish(tmp_path / "out", said.append)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["preview_000001.png"]
    assert len(said) == 1
    assert "preview_000002.png" in said[0]


@pytest.mark.parametrize("number", [errno.EMFILE, errno.EIO])
def test_no_preview_is_left_out_for_what_the_system_refuses(found: Previews, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    def refused(path: Path) -> str:
        raise OSError(number, os.strerror(number), str(path))

    monkeypatch.setattr(previews, "digest_of", refused)
    with pytest.raises(OSError, match=r"preview_000001\.png"):
        found.publish(tmp_path / "out", print)
