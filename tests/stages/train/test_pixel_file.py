"""Training pixels in a file: what an array gives, and what becomes of the file."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from stages.train.pixel_file import PixelFile


def filled(folder: Path, channels: int = 3, count: int = 1000) -> tuple[PixelFile, np.ndarray]:
    values = np.random.default_rng(0).integers(0, 256, (count, channels), dtype=np.uint8)
    rows = PixelFile(count, channels, folder)
    for at in range(0, count, 300):
        rows[at : at + 300] = values[at : at + 300]
    return rows, values


@pytest.mark.parametrize("channels", [3, 4])
def test_rows_are_those_of_an_array(tmp_path: Path, channels: int) -> None:
    rows, values = filled(tmp_path, channels)
    assert (len(rows), rows.shape, rows.nbytes) == (1000, values.shape, values.nbytes)
    at = np.random.default_rng(1).integers(1000, size=200)
    assert np.array_equal(rows[at], values[at])
    assert np.array_equal(rows[990:2000], values[990:2000])
    assert rows[at[:0]].shape == (0, channels)


def test_a_full_disk_shows_before_an_image_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(OSError, match="space"):
        PixelFile(10, 3, tmp_path)
