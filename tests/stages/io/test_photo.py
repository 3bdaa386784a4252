"""Photographs read upright, with their masks and focal lengths."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from efficientnerf.geometry.cameras import Camera
from stages.io import photo as reading
from stages.io import working_images
from stages.io.capture import Photo
from stages.sfm.images import prepare_images


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_undone(tmp_path: Path, orientation: int) -> None:
    seen = np.random.default_rng(0).integers(0, 255, (20, 30, 3), np.uint8)
    undo = {2: 0, 3: 3, 4: 1, 5: 5, 6: 2, 7: 6, 8: 4}  # Pillow's Transpose that turns the upright picture into the stored one
    stored = Image.fromarray(seen)
    if orientation > 1:
        stored = stored.transpose(Image.Transpose(undo[orientation]))
    exif = Image.Exif()
    exif[274] = orientation
    stored.save(tmp_path / "a.png", exif=exif)
    photo = reading.read_photo(tmp_path / "a.png", 1600)
    assert (photo.width, photo.height) == (30, 20)
    np.testing.assert_array_equal(photo.rgb, seen)


@pytest.mark.parametrize(("masks", "masked"), [({}, True), ({"a.png": None}, False)])
def test_what_is_transparent_may_count(masks: dict[str, Path | None], masked: bool, tmp_path: Path) -> None:
    rgba = np.random.default_rng(0).integers(0, 256, (40, 60, 4), np.uint8)
    rgba[..., 3] = np.where(np.arange(60) < 30, 0, 255)
    Image.fromarray(rgba).save(tmp_path / "a.png")
    quiet: dict[str, Any] = {"progress": lambda *_: None, "safe_point": lambda: None, "warn": lambda *_: None}
    for _ in range(2):  # the second finds what the first left
        images, _ = prepare_images({"a.png": tmp_path / "a.png"}, max_side=60, features=100, seed=0, masks=masks, work=tmp_path / "work", **quiet)
        assert len(images) == 1
        assert (tmp_path / "work/masks" / f"{images[0].file}.png").exists() == masked


@pytest.mark.parametrize("size", [(40, 40), (40, 30)])
@pytest.mark.parametrize("tagged", [False, True])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_masks_are_turned_alike_for_features_and_for_working_images(tmp_path: Path, orientation: int, tagged: bool, size: tuple[int, int]) -> None:
    exif = Image.Exif()
    exif[274] = orientation
    Image.new("RGB", size).save(tmp_path / "a.png", exif=exif)
    marked = np.zeros(size[::-1], np.uint8)
    marked[2:8, 5:30] = 255
    Image.fromarray(marked).save(tmp_path / "m.png", exif=exif if tagged else None)
    photo = reading.read_photo(tmp_path / "a.png", 100)
    for_features = reading.read_mask_file(tmp_path / "m.png", photo)
    camera = Camera("a.png", photo.width, photo.height, "SIMPLE_PINHOLE", (40.0, 20.0, 20.0), np.eye(4))
    written = working_images.write(Photo(camera, tmp_path / "a.png", tmp_path / "m.png"), tmp_path / "out", "a.png", max_side=100)
    assert written.mask is not None
    with Image.open(tmp_path / "out" / written.mask) as mask:
        np.testing.assert_array_equal(np.asarray(mask) > 0, for_features)


@pytest.mark.parametrize("kind", ["16-bit labels", "blue labels", "lossy"])
def test_masks_mark_the_same_pixels_for_features_and_for_working_images(tmp_path: Path, kind: str) -> None:
    marked = np.zeros((30, 40), bool)
    marked[8:24, 8:32] = True
    Image.new("RGB", (40, 30)).save(tmp_path / "a.png")
    file = tmp_path / ("m.jpg" if kind == "lossy" else "m.png")
    match kind:
        case "16-bit labels":
            Image.fromarray(marked.astype(np.uint16) * 3).save(file)
        case "blue labels":
            Image.fromarray(marked[..., None] * np.array([0, 0, 2], np.uint8)).save(file)
        case "lossy":  # noise where it is black
            Image.fromarray(np.where(marked, 250, 9).astype(np.uint8)).save(file, quality=40)
    photo = reading.read_photo(tmp_path / "a.png", 100)
    np.testing.assert_array_equal(reading.read_mask_file(file, photo), marked)
    camera = Camera("a.png", photo.width, photo.height, "SIMPLE_PINHOLE", (40.0, 20.0, 20.0), np.eye(4))
    written = working_images.write(Photo(camera, tmp_path / "a.png", file), tmp_path / "out", "a.png", max_side=100)
    assert written.mask is not None
    with Image.open(tmp_path / "out" / written.mask) as mask:
        np.testing.assert_array_equal(np.asarray(mask) > 0, marked)
