"""Masks that users bring: what they are called, which level of them is kept, and what is done where nothing is known of the cameras yet."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipeline.errors import BadInput
from stages.formats.importers.masks import masks_of
from stages.formats.importers.source import Source
from stages.io.capture import Capture, Photo
from stages.io.photo import read_mask_file, read_photo
from stages.io.reader import PhotoReader
from stages.masking import photographs
from stages.masking.polarity import kept_white
from tests.stages import captures

W, H = 96, 72


def drawn(index: int, camera: Any) -> np.ndarray:
    """(H, W) uint8, 255 where a ball of radius 0.8 round the origin is; the camera's pixels are a third as many along each side."""
    from efficientnerf.geometry.cameras import rays, resized

    origins, directions = rays(resized(camera, W, H))
    closest = origins - (origins * directions).sum(1, keepdims=True) * directions
    return np.where((np.linalg.norm(closest, axis=1) < 0.8).reshape(H, W), np.uint8(255), np.uint8(0))


def wandering(index: int, camera: Any) -> np.ndarray:
    y, x = np.mgrid[:H, :W] + 0.5
    return np.where(np.hypot(x - (15, 81, 42, 24, 75, 54)[index], y - (18, 54, 15, 57, 15, 54)[index]) < 12, np.uint8(255), np.uint8(0))


def sources(folder: Path, draw: Any, *, black: bool) -> tuple[dict[str, Path], dict[str, Path]]:
    """Photographs and masks by name."""
    paths, masks = {}, {}
    for index, camera in enumerate(captures.cameras()):
        paths[camera.name] = captures.write_picture(folder / camera.name, captures.picture(index, W, H))
        mask = draw(index, camera)
        masks[camera.name] = captures.write_picture(folder / "masks" / camera.name, 255 - mask if black else mask)
    return paths, masks


@pytest.mark.parametrize("name", ["IMG_1.png", "img_1.PNG", "IMG_1.jpg.png", "IMG_1.mask.png", "IMG_1.jpg.mask", "IMG_1.mask", "IMG_1_mask.png"])
@pytest.mark.parametrize("place", ["masks", "images/masks"])
def test_masks_are_found_by_the_names_that_other_programs_give_them(tmp_path: Path, name: str, place: str) -> None:
    image = captures.write_picture(tmp_path / "images" / "IMG_1.jpg", captures.picture(0, W, H))
    captures.write_picture(tmp_path / "images" / "IMG_10.jpg", captures.picture(1, W, H))
    (tmp_path / place).mkdir()
    with open(tmp_path / place / name, "wb") as file:
        Image.fromarray(np.full((H, W), 255, np.uint8)).save(file, "PNG")
    assert masks_of(Source(tmp_path), sorted((tmp_path / "images").glob("*.jpg"))) == {image: tmp_path / place / name}


@pytest.mark.parametrize("black", [False, True])
@pytest.mark.parametrize("polarity", ["auto", "white", "black"])
def test_masks_keep_white_from_here_on(tmp_path: Path, black: bool, polarity: str) -> None:
    paths, masks = sources(tmp_path, drawn, black=black)
    events: list[dict[str, Any]] = []
    kept, inverted = kept_white(captures.poses_job(tmp_path, tmp_path, events.append, mask_polarity=polarity), paths, masks, PhotoReader())
    assert any("keep what is black" in event["text"] for event in events) == (polarity == "black")
    assert bool(inverted) == (polarity == "auto" and black)
    for index, camera in enumerate(captures.cameras()):
        photo, inside = read_photo(paths[camera.name], 100), drawn(index, camera) > 0
        np.testing.assert_array_equal(read_mask_file(kept[camera.name], photo), inside != (black != (polarity == "black")))
        if inverted:
            np.testing.assert_array_equal(read_mask_file(inverted[camera.name], photo), inside)
    assert kept_white(captures.poses_job(tmp_path, tmp_path, masks="ignore"), paths, masks, PhotoReader()) == (masks, {})


@pytest.mark.parametrize("surroundings", [True, False])
@pytest.mark.parametrize("draw", [drawn, wandering])
def test_cameras_show_whether_black_is_one_thing(tmp_path: Path, draw: Any, surroundings: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """What moves through a scene is left out, as it is drawn; one object is kept, also where nothing but itself shows how it turned."""
    paths, masks = sources(tmp_path, draw, black=True)

    def find(name: str, given: Mapping[str, Path | None]) -> Capture:
        if not surroundings and given in (masks, {}):
            raise BadInput("no cameras")
        cameras = [replace(camera, width=W, height=H, params=tuple(3 * p for p in camera.params)) for camera in captures.cameras()]
        return Capture("photographs", tuple(Photo(camera, paths[camera.name], given.get(camera.name)) for camera in cameras), None)

    monkeypatch.setattr(photographs, "_search", lambda *_: find)
    events: list[dict[str, Any]] = []
    job = captures.poses_job(tmp_path, tmp_path, events.append)
    if draw is wandering and not surroundings:
        with pytest.raises(BadInput):
            photographs.cameras_of_photographs(job, PhotoReader(tmp_path / "photographs"), lambda *_, **__: None)
        return
    capture = photographs.cameras_of_photographs(job, PhotoReader(tmp_path / "photographs"), lambda *_, **__: None)
    assert any("keep what is black" in event.get("text", "") for event in events) == (draw is drawn)
    for index, photo in enumerate(capture.photos):
        assert photo.mask is not None
        if draw is wandering:
            assert photo.mask == masks[photo.camera.name]
        else:
            np.testing.assert_array_equal(read_mask_file(photo.mask, read_photo(photo.image, 100)), drawn(index, captures.cameras()[index]) > 0)
