"""Panoramas and the views that are cut from them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipeline.errors import Interrupted
from stages.io.photo import read_photo
from stages.video.panorama import VIEWS, cut, directions, is_panorama, view_side, views_of
from tests.stages import captures

GPANO = b'<x:xmpmeta><rdf:Description GPano:ProjectionType="equirectangular"/></x:xmpmeta>'


def colours(direction: np.ndarray) -> np.ndarray:
    """A smooth picture of all directions (..., 3): its colours are the direction."""
    unit = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    return (127.5 + 120 * unit).astype(np.float32)


def panorama(height: int = 128) -> np.ndarray:
    """(H, 2 H, 3) uint8: the middle looks along z, columns go to the right."""
    longitude = ((np.arange(2 * height) + 0.5) / (2 * height) - 0.5) * 2 * np.pi
    latitude = ((np.arange(height) + 0.5) / height - 0.5) * np.pi
    lon, lat = np.meshgrid(longitude, latitude)
    return colours(np.stack([np.cos(lat) * np.sin(lon), np.sin(lat), np.cos(lat) * np.cos(lon)], -1)).round().astype(np.uint8)


def write(path: Path, **options: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(panorama()).save(path, **options)
    return path


@pytest.mark.parametrize("view", range(VIEWS))
def test_a_view_shows_what_lies_in_its_directions(view: int) -> None:
    side = 48
    found, expected = cut(panorama(), side, view), colours(directions(side, view))
    assert np.abs(found - expected).max() <= 2.5  # through the seam at the back, too
    middle = directions(side, view).mean(axis=(0, 1))
    np.testing.assert_allclose(np.degrees(np.arctan2(middle[0], middle[2])) % 360, 360 * view / VIEWS, atol=1e-9)


def test_panoramas_are_recognised_by_shape_and_what_they_say(tmp_path: Path) -> None:
    assert is_panorama(write(tmp_path / "a.jpg", xmp=GPANO))
    assert is_panorama(write(tmp_path / "a.webp", xmp=GPANO))
    assert not is_panorama(write(tmp_path / "b.jpg"))
    captures.write_picture(tmp_path / "c.jpg", captures.picture(), xmp=GPANO)
    (tmp_path / "d.jpg").write_bytes(b"no picture")
    assert not is_panorama(tmp_path / "c.jpg")
    assert not is_panorama(tmp_path / "d.jpg")


def test_views_are_written_with_their_focal_length_and_again_after_a_kill(tmp_path: Path) -> None:
    pictures = {name: write(tmp_path / name) for name in ("a.png", "b/a.png")}
    quiet: dict[str, Any] = {"progress": lambda *values: None, "warn": lambda text: None, "max_side": 1000}
    whole = views_of(pictures, work=tmp_path / "whole", safe_point=lambda: None, **quiet)
    assert [name for name in whole if name.startswith("a.png/")] == [f"a.png/{degrees:03d}.png" for degrees in range(0, 360, 45)]
    assert len(whole) == 2 * VIEWS
    for path in whole.values():
        photo = read_photo(path, 1000)
        assert photo.focal == pytest.approx(photo.width / 2)
        assert photo.width == photo.height == view_side(256, 1000)
        assert photo.maker == "panorama"
    points = iter(range(100))

    def stop() -> None:
        if next(points) == VIEWS + 3:
            raise Interrupted(2)

    with pytest.raises(Interrupted):
        views_of(pictures, work=tmp_path / "killed", safe_point=stop, **quiet)
    again = views_of(pictures, work=tmp_path / "killed", safe_point=lambda: None, **quiet)
    assert {name: path.read_bytes() for name, path in again.items()} == {name: path.read_bytes() for name, path in whole.items()}
