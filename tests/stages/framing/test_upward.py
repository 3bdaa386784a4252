"""Up by all that says it: accelerometers of phones, markers, the floor; in agreement, or named where they contradict each other."""

import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from efficientnerf.capture.supports import level_plane
from stages.framing.upward import with_up
from stages.io.capture import Capture, Photo, SparsePoints
from stages.io.photo import read_gravity
from tests.efficientnerf.capture.rings import cameras_round

UP = np.array([0.2, -0.3, 0.93]) / np.linalg.norm([0.2, -0.3, 0.93])


def phone(path: Path, acceleration: np.ndarray, orientation: int = 1) -> Path:
    """A picture with the maker note of an iPhone: x right and y up of the phone held upright, z towards its user, in g."""
    exif = Image.Exif()
    exif[274] = orientation
    numbers = [n for x in acceleration for n in (round(1e6 * float(x)), 10**6)]
    entries = struct.pack(">HHIi", 1, 9, 1, 4) + struct.pack(">HHII", 8, 10, 3, 44)
    exif.get_ifd(34665)[37500] = b"Apple iOS\0\0\1MM" + struct.pack(">H", 2) + entries + bytes(4) + struct.pack(">6i", *numbers)
    Image.new("RGB", (8, 6), (90, 90, 90)).save(path, exif=exif)
    return path


@pytest.mark.parametrize(
    ("acceleration", "orientation", "down"),
    [
        ((0, -0.9, -0.43), 6, (0, 0.9, 0.43)),  # upright, its camera to the ground
        ((-0.9, 0.05, -0.43), 1, (-0.05, 0.9, 0.43)),  # on its left side, as in the photograph IMG_1049 of an iPhone 7
        ((0.9, 0.05, -0.43), 3, (0.05, 0.9, 0.43)),
        ((0.1, 0.9, 0.43), 8, (-0.1, 0.9, -0.43)),  # head down
    ],
)
def test_gravity_is_turned_as_the_picture_is(tmp_path: Path, acceleration: Any, orientation: int, down: Any) -> None:
    found = read_gravity(phone(tmp_path / "a.jpg", np.array(acceleration), orientation))
    np.testing.assert_allclose(found, down / np.linalg.norm(down), atol=1e-5)


def test_a_phone_that_was_shaken_and_a_damaged_note_say_nothing(tmp_path: Path) -> None:
    assert read_gravity(phone(tmp_path / "a.jpg", np.array([0, -1.5, 0]))) is None
    whole = phone(tmp_path / "b.jpg", np.array([0, -1.0, 0])).read_bytes()
    at = whole.index(b"Apple iOS")
    for change in (b"\xff\xff", b"\0\0"):
        (tmp_path / "c.jpg").write_bytes(whole[: at + 14] + change + whole[at + 16 :])
        read_gravity(tmp_path / "c.jpg")
    (tmp_path / "d.jpg").write_bytes(whole.replace(struct.pack(">I", 44), struct.pack(">I", 2**31)))
    assert read_gravity(tmp_path / "d.jpg") is None


def capture(folder: Path, tilt: float, floor: np.ndarray | None = None) -> Capture:
    """Photographs of a phone, whose accelerometer is off by up to `tilt` degrees; and points on a floor with this normal."""
    rng, photos = np.random.default_rng(0), []
    for camera in cameras_round(10, rng):
        x, y, z = camera.world_from_camera[:3, :3].T @ -(UP + np.radians(tilt) * rng.uniform(-1, 1, 3))
        photos.append(Photo(camera, phone(folder / camera.name.replace("png", "jpg"), np.array([-y, -x, -z]))))
    points = None
    if floor is not None:
        places = rng.uniform(-1, 1, (600, 3))
        xyz = np.concatenate([places - (places @ floor)[:, None] * floor, rng.normal(0, 0.2, (200, 3)) + 0.3 * floor])
        points = SparsePoints(xyz, np.zeros((800, 3), np.uint8), np.zeros(800), ())
    return Capture("photographs", tuple(photos), None, points=points)


def asked(given: Capture, choice: str = "auto") -> tuple[Capture, list[str], list[str]]:
    said: list[str] = []
    warned: list[str] = []
    return with_up(given, choice, said.append, warned.append), said, warned


def test_phones_give_up_and_what_agrees_is_in_the_facts(tmp_path: Path) -> None:
    found, said, warned = asked(capture(tmp_path, 2.0, UP))
    facts: Any = found.facts["up"]
    assert found.up is not None
    assert found.up @ UP > np.cos(np.radians(1.0))
    assert (facts["by"], said, warned) == ("gravity", [], [])
    assert facts["degrees"]["the floor or table"] < 1
    shaken, _, _ = asked(capture(tmp_path, 60.0))
    assert (shaken.up, shaken.facts["up"]["by"]) == (None, "level cameras")  # type: ignore[index]


def test_what_contradicts_is_named(tmp_path: Path) -> None:
    other = UP + np.array([0.0, 0.2, 0.0])
    other /= np.linalg.norm(other)
    phones = capture(tmp_path, 1.0, other)
    found, said, _ = asked(phones)
    assert "floor or table is 1" in said[0]
    assert found.up @ UP > np.cos(np.radians(1.0))  # type: ignore[operator]
    markers = replace(phones, markers_up=other)
    found, _, warned = asked(markers)
    assert "up is taken from markers, and contradicted by gravity (1" in warned[0]
    np.testing.assert_allclose(found.up, other)  # type: ignore[arg-type]
    given, _, warned = asked(replace(phones, up=np.array([0.0, 0.0, 1.0])), "x")
    assert (given.up.tolist(), given.facts["up"]["by"]) == ([0, 0, 1], "poses.up")  # type: ignore[union-attr, index]
    assert "the source (90 degrees)" in warned[0]


def test_a_floor_is_a_plane_and_a_cloud_is_none() -> None:
    rng = np.random.default_rng(1)
    cameras = np.array([camera.centre for camera in cameras_round(8, rng)])
    cloud, wall = rng.normal(0, 0.5, (3000, 3)), rng.uniform(-1, 1, (3000, 3)) * [1, 0, 1]
    assert level_plane(cloud, cameras, UP) is None
    assert level_plane(wall, cameras, UP) is None
    assert level_plane(np.zeros((2, 3)), cameras, UP) is None
    found = level_plane(np.concatenate([cloud, rng.uniform(-1, 1, (1000, 3)) * [1, 1, 0.005]]), cameras, UP)
    assert found is not None
    assert found[0][2] > np.cos(np.radians(0.5))
    assert level_plane(np.concatenate([cloud, rng.uniform(-1, 1, (1000, 3)) * [1, 1, 0.005]]), -cameras, UP) is None  # they are below it
