"""GPS positions give cameras their scale and upward axis where they are exact enough for the extent of the capture, and nothing where they are not."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from efficientnerf.geometry.cameras import Camera, Similarity
from stages.framing.gps import enu_from_gps, robust_similarity, with_gps, with_stated_cameras
from stages.io.capture import Capture, Photo, SparsePoints
from stages.io.photo import read_gps_position
from stages.sfm.colmap import import_pycolmap
from stages.verdict.verdict import verdict_on

HOME = np.array([55.7047, 13.1910, 62.0])


def sexagesimal(degrees: float) -> tuple[float, float, float]:
    whole, rest = divmod(abs(degrees), 1)
    minutes, rest = divmod(rest * 60, 1)
    return whole, minutes, rest * 60


def tags(position: np.ndarray) -> dict[int, Any]:
    latitude, longitude, altitude = (float(value) for value in position)
    return {
        1: "N" if latitude >= 0 else "S",
        2: sexagesimal(latitude),
        3: "E" if longitude >= 0 else "W",
        4: sexagesimal(longitude),
        5: b"\x00" if altitude >= 0 else b"\x01",
        6: abs(altitude),
    }


def write(path: Path, gps: dict[int, Any] | None) -> Path:
    exif = Image.Exif()
    if gps is not None:
        exif[34853] = gps
    Image.new("RGB", (8, 6), (90, 90, 90)).save(path, exif=exif)
    return path


@pytest.mark.parametrize("position", [(55.7047, 13.1910, 62.5), (-33.85, -151.2, -3.25), (0.0, -0.5, 0.0)])
def test_positions_are_read_on_all_sides(tmp_path: Path, position: tuple[float, float, float]) -> None:
    found = read_gps_position(write(tmp_path / "a.jpg", tags(np.array(position))))
    np.testing.assert_allclose(found, position, atol=1e-7)  # type: ignore[arg-type]


def test_metres_are_those_of_colmap() -> None:
    rng = np.random.default_rng(0)
    for home in (HOME, np.array([-33.9, -151.2, 5.0]), np.array([0.0, 179.9, 0.0])):
        positions = home + rng.normal(0, 1, (20, 3)) * [0.01, 0.01, 50.0]
        pycolmap = import_pycolmap()
        expected = pycolmap.GPSTransform(pycolmap.GPSTransformEllipsoid.WGS84).ellipsoid_to_enu(positions, *positions[0])
        expected = np.asarray(expected)
        np.testing.assert_allclose(enu_from_gps(positions), expected, atol=1e-3)


def rotation(rng: np.random.Generator) -> np.ndarray:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def test_a_similarity_is_found_in_spite_of_outliers() -> None:
    rng = np.random.default_rng(1)
    true = Similarity(3.7, rotation(rng), np.array([5.0, -2.0, 100.0]))
    points = rng.normal(0, 1, (40, 3))
    target = true.points(points)
    target[::8] += rng.normal(0, 50, (5, 3))
    found = robust_similarity(points, target)
    np.testing.assert_allclose(found.matrix(), true.matrix(), atol=0.05)


def capture(tmp_path: Path, centres: np.ndarray, noise: float, rng: np.random.Generator, known: int = 99) -> tuple[Capture, dict[str, Path], Similarity]:
    """A capture in a frame of its own, with photographs whose positions (centres in metres east, north, up) are off by so much."""
    to_metres = Similarity(0.37, rotation(rng), rng.normal(0, 5, 3))
    own = to_metres.inverse()
    metres = np.pi / 180 * 6378137.0
    files, photos = {}, []
    for n, centre in enumerate(centres):
        east, north, height = centre + rng.normal(0, noise, 3) if noise else centre
        position = HOME + np.array([north / metres * 1.00168, east / metres / np.cos(np.radians(HOME[0])) / 1.00229, height])
        name = f"{n:02d}.jpg"
        files[name] = write(tmp_path / name, tags(position) if n < known else None)
        pose = np.eye(4)
        pose[:3, 3] = own.points(centre)
        photos.append(Photo(Camera(name, 8, 6, "SIMPLE_PINHOLE", (8.0, 4.0, 3.0), pose), files[name]))
    points = SparsePoints(own.points(centres), np.zeros(centres.shape, np.uint8), np.zeros(len(centres)), tuple((0,) for _ in centres))
    return Capture("photographs", tuple(photos), None, points=points), files, to_metres


CIRCLE = np.array([[40 * np.cos(a), 40 * np.sin(a), 20 + 5 * np.sin(3 * a)] for a in np.linspace(0, 6, 24)])


def lengths(found: Capture) -> np.ndarray:
    centres = np.array([photo.camera.centre for photo in found.photos])
    return np.linalg.norm(centres[:, None] - centres[None], axis=2)


def test_exact_positions_give_metres_and_the_upward_axis(tmp_path: Path) -> None:
    given, files, _ = capture(tmp_path, CIRCLE, 0.3, np.random.default_rng(2))
    found, sentence = with_gps(given, files)
    assert found.metric
    np.testing.assert_array_equal(found.up, [0, 0, 1])
    assert found.provenance.gps.used == "scale and up"
    assert "scale and upward axis" in sentence
    true = np.linalg.norm(CIRCLE[:, None] - CIRCLE[None], axis=2)
    np.testing.assert_allclose(lengths(found), true, rtol=0.01, atol=0.01)
    heights = np.array([photo.camera.centre[2] for photo in found.photos])
    np.testing.assert_allclose(heights - heights.mean(), CIRCLE[:, 2] - CIRCLE[:, 2].mean(), atol=0.8)
    np.testing.assert_allclose(found.points.xyz, [photo.camera.centre for photo in found.photos], atol=1e-9)  # moved together
    for photo, before in zip(found.photos, given.photos, strict=True):
        np.testing.assert_allclose(photo.camera.world_from_camera[:3, :3] @ photo.camera.world_from_camera[:3, :3].T, np.eye(3), atol=1e-9)
        assert photo.camera.params == before.camera.params


@pytest.mark.parametrize(("extent", "noise", "known"), [(0.05, 4.0, 99), (1.0, 0.1, 11), (0.0, 0.0, 99)])
def test_positions_that_say_nothing_change_nothing(tmp_path: Path, extent: float, noise: float, known: int) -> None:
    given, files, _ = capture(tmp_path, CIRCLE, 0.0, np.random.default_rng(5), known)
    rng = np.random.default_rng(6)
    for (name, file), centre in zip(files.items(), CIRCLE, strict=True):
        if int(name[:2]) < known:
            metres = np.pi / 180 * 6378137.0
            offset = extent * centre + rng.normal(0, noise, 3)
            write(file, tags(HOME + np.array([offset[1] / metres, offset[0] / metres / 0.56, offset[2]])))
    found, sentence = with_gps(given, files)
    assert (found.metric, found.up) == (False, None)
    assert found.provenance.gps.used == "nothing"
    assert sentence == "", "the terminal need not have it"
    (problem,) = (each for each in verdict_on(found, {}).problems if each.what == "gps")
    assert problem.grade == "good"
    assert ("all of them the same one" in problem.sentence) == (noise == 0)
    np.testing.assert_array_equal(lengths(found), lengths(given))


def stated_for(found: Capture, centres: np.ndarray, **changes: Any) -> Capture:
    """What an app says of the cameras of these photographs: metres, y up."""
    photos = []
    for photo, centre in zip(found.photos, centres, strict=True):
        pose = np.eye(4)
        pose[:3, 3] = centre
        photos.append(Photo(Camera(photo.camera.name, 8, 6, "SIMPLE_PINHOLE", (8.0, 4.0, 3.0), pose), photo.image))
    return Capture("polycam", tuple(photos), None, up=np.array([0.0, 1.0, 0.0]), metric=True, **changes)


def test_found_cameras_come_into_the_frame_of_stated_ones(tmp_path: Path) -> None:
    given, _, _ = capture(tmp_path, CIRCLE, 0.0, np.random.default_rng(2), 0)
    drifted = 0.1 * CIRCLE + np.random.default_rng(3).normal(0, 0.05, CIRCLE.shape)  # the phone's tracking
    drifted[5] += 3.0  # which was lost once
    found, sentence = with_stated_cameras(given, stated_for(given, drifted))
    assert (found.metric, found.provenance.stated_cameras.used) == (True, "frame")
    np.testing.assert_array_equal(found.up, [0, 1, 0])
    centres = np.array([photo.camera.centre for photo in found.photos])
    np.testing.assert_allclose(centres, 0.1 * CIRCLE, atol=0.06)
    np.testing.assert_allclose(found.points.xyz, centres, atol=1e-9)
    assert "24 of the 24 photographs (polycam)" in sentence
