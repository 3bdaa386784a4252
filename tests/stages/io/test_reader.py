"""Photographs and masks of a stage: each decoded once for a size, and again where the file or what was kept of it has changed."""

import os
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from efficientnerf.geometry.cameras import Camera
from stages.io import reader as reading
from stages.io.capture import Photo
from stages.io.photo import PhotoDetails, read_photo
from stages.io.png import read_png, write_png
from stages.io.reader import PhotoReader


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The photographs that are decoded, in order."""
    found: list[Path] = []

    def read(path: Path, max_side: int) -> object:
        found.append(path)
        return read_photo(path, max_side)

    monkeypatch.setattr(reading, "read_photo", read)
    return found


def picture(path: Path, seed: int = 0, alpha: bool = False) -> Path:
    pixels = np.random.default_rng(seed).integers(0, 256, (60, 80, 4 if alpha else 3), np.uint8)
    write_png(pixels, path)
    return path


@pytest.mark.parametrize("alpha", [False, True])
def test_what_was_decoded_is_read_again_until_it_changes(tmp_path: Path, counted: list[Path], alpha: bool) -> None:
    path, folder = picture(tmp_path / "a.png", 0, alpha), tmp_path / "photographs"
    expected = read_photo(path, 40)
    for _ in range(2):
        kept = PhotoReader(folder).photo(path, 40)
        np.testing.assert_array_equal(kept.rgb(), expected.rgb)
        np.testing.assert_array_equal(read_png(kept.image), expected.rgb)
        assert kept.details == PhotoDetails(**{each.name: getattr(expected, each.name) for each in fields(PhotoDetails)})
        assert (kept.opaque is not None) == alpha
        if kept.opaque is not None:
            np.testing.assert_array_equal(read_png(kept.opaque) > 0, expected.opaque)
    assert counted == [path]
    PhotoReader(folder).photo(path, 20)
    assert len(counted) == 2, "of another size"
    picture(path, 1)
    np.testing.assert_array_equal(PhotoReader(folder).photo(path, 40).rgb(), read_photo(path, 40).rgb)
    assert len(counted) == 3
    kept.image.write_bytes(kept.image.read_bytes()[:-20])
    picture(path, 0, alpha)
    for _ in range(2):
        np.testing.assert_array_equal(PhotoReader(folder).photo(path, 40).rgb(), expected.rgb)
    assert len(counted) == 4


def test_a_mask_that_is_written_anew_or_turned_round_is_read_again(tmp_path: Path) -> None:
    camera = Camera("a.png", 80, 60, "SIMPLE_PINHOLE", (80.0, 40.0, 30.0), np.eye(4))
    mask = tmp_path / "mask.png"
    Image.fromarray(np.where(np.arange(80) < 20, 255, 0).astype(np.uint8)[None].repeat(60, 0)).save(mask)
    reader, photo = PhotoReader(), Photo(camera, picture(tmp_path / "a.png"), mask)
    first, turned = reader.mask(photo), reader.mask(Photo(camera, photo.image, mask, "white"))
    assert reader.mask(photo) is first
    assert first is not None
    assert turned is not None
    assert ((first > 0) != (turned > 0)).all()
    Image.fromarray(np.full((60, 80), 255, np.uint8)).save(tmp_path / "other.png")
    os.replace(tmp_path / "other.png", mask)
    again = reader.mask(photo)
    assert again is not None
    assert (again > 0).all()
