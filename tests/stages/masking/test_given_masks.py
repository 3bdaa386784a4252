"""Masks that users bring: what they are called, and which level of them is kept."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from efficientnerf.geometry.cameras import rays, resized
from pipeline.stage import Job
from stages.formats.importers.masks import masks_of
from stages.formats.importers.source import Source
from stages.io.photo import read_mask_file, read_photo
from stages.masking.polarity import kept_white
from stages.poses.settings import PosesSettings
from tests.stages import captures

W, H = 96, 72


def drawn(camera: Any) -> np.ndarray:
    """(H, W) uint8, 255 where a ball of radius 0.8 round the origin is; the camera's pixels are a third as many along each side."""
    origins, directions = rays(resized(camera, W, H))
    closest = origins - (origins * directions).sum(1, keepdims=True) * directions
    return np.where((np.linalg.norm(closest, axis=1) < 0.8).reshape(H, W), np.uint8(255), np.uint8(0))


def sources(folder: Path) -> tuple[dict[str, Path], dict[str, Path]]:
    """Photographs and masks by name."""
    paths, masks = {}, {}
    for index, camera in enumerate(captures.cameras()):
        paths[camera.name] = captures.write_picture(folder / camera.name, captures.picture(index, W, H))
        masks[camera.name] = captures.write_picture(folder / "masks" / camera.name, drawn(camera))
    return paths, masks


def job_in(folder: Path, events: list[dict[str, Any]], **settings: Any) -> Job:
    (folder / "work").mkdir(parents=True, exist_ok=True)
    return Job(settings=PosesSettings(**settings), out=folder / "out", work=folder / "work", source=folder, stage="poses", report=events.append)


@pytest.mark.parametrize("name", ["IMG_1.png", "img_1.PNG", "IMG_1.jpg.png", "IMG_1.mask.png", "IMG_1.jpg.mask", "IMG_1.mask", "IMG_1_mask.png"])
@pytest.mark.parametrize("place", ["masks", "images/masks"])
def test_masks_are_found_by_the_names_that_other_programs_give_them(tmp_path: Path, name: str, place: str) -> None:
    image = captures.write_picture(tmp_path / "images" / "IMG_1.jpg", captures.picture(0, W, H))
    captures.write_picture(tmp_path / "images" / "IMG_10.jpg", captures.picture(1, W, H))
    (tmp_path / place).mkdir()
    with open(tmp_path / place / name, "wb") as file:
        Image.fromarray(np.full((H, W), 255, np.uint8)).save(file, "PNG")
    assert masks_of(Source(tmp_path), sorted((tmp_path / "images").glob("*.jpg"))) == {image: tmp_path / place / name}


@pytest.mark.parametrize("polarity", ["white", "black"])
def test_masks_keep_white_from_here_on(tmp_path: Path, polarity: str) -> None:
    paths, masks = sources(tmp_path)
    events: list[dict[str, Any]] = []
    kept = kept_white(job_in(tmp_path, events, mask_polarity=polarity), paths, masks)
    assert any("keep what is black" in event["text"] for event in events) == (polarity == "black")
    for camera in captures.cameras():
        photo, inside = read_photo(paths[camera.name], 100), drawn(camera) > 0
        np.testing.assert_array_equal(read_mask_file(kept[camera.name], photo), inside == (polarity == "white"))
