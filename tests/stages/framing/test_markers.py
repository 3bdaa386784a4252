"""Markers in made photographs give metres and up, or are refused."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from efficientnerf.geometry.cameras import Camera, project
from efficientnerf.rendering.colour import srgb_from_linear
from pipeline.errors import BadInput
from pipeline.stage import Job
from stages.framing.markers import with_markers
from stages.io.capture import Capture, Photo, SparsePoints
from stages.io.png import write_png
from stages.poses.settings import PosesSettings
from tests.poses import looking_at

EDGE = 0.05  # metres, of a capture whose unit is UNIT metres
UNIT = 0.31
WIDTH, HEIGHT, FOCAL = 900, 700, 900.0
PLACES = ((-0.12, -0.09), (0.12, -0.09), (-0.1, 0.1), (0.11, 0.09))
TRUE_UP = np.array([0.3, -0.2, 0.93]) / np.linalg.norm([0.3, -0.2, 0.93])


def cameras() -> list[Camera]:
    side = np.cross(TRUE_UP, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    other = np.cross(TRUE_UP, side)
    found = []
    for index, angle in enumerate(np.linspace(0.0, 4.0, 6)):
        centre = (0.5 * (np.cos(angle) * side + np.sin(angle) * other) + (0.45 + 0.03 * index) * TRUE_UP) / UNIT
        pose = looking_at(centre, up=TRUE_UP)
        found.append(Camera(f"{index}.png", WIDTH, HEIGHT, "PINHOLE", (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2), pose))
    return found


def capture_of(
    folder: Path, dictionary: str = "APRILTAG_36h11", moving: tuple[int, ...] = (), sizes: tuple[float, ...] = (1, 1, 1, 1), blur: float = 0.8
) -> Capture:
    rng = np.random.default_rng(0)
    side = np.cross(TRUE_UP, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    plane = np.stack([side, np.cross(TRUE_UP, side)])
    photos = []
    for view, camera in enumerate(cameras()):
        light = np.full((2 * HEIGHT, 2 * WIDTH), 0.6, np.float32)
        for number, (place, size) in enumerate(zip(PLACES, sizes, strict=True)):
            tag = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}")), number, 240) / 255.0
            drawn = np.pad(tag, 30, constant_values=1.0).astype(np.float32) * 0.55 + 0.05
            shift = np.array([0.02 * view, 0.0]) if number in moving else np.zeros(2)
            half = EDGE * size / 2
            flat = np.array(place) + shift + half * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
            pixels, _ = project(camera, flat @ plane / UNIT)
            to = 2 * pixels.astype(np.float32) - 0.5
            matrix = cv2.getPerspectiveTransform(np.array([[30, 30], [270, 30], [270, 270], [30, 270]], np.float32) - 0.5, to)
            printed = cv2.warpPerspective(drawn, matrix, light.shape[::-1])
            cover = cv2.warpPerspective(np.ones_like(drawn), matrix, light.shape[::-1])
            light = np.where(cover > 0.99, printed, light)
        light = cv2.GaussianBlur(cv2.resize(light, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA), (0, 0), blur)
        grey = np.clip(np.rint(255 * srgb_from_linear(light) + rng.normal(0, 2, light.shape)), 0, 255).astype(np.uint8)
        write_png(np.dstack([grey] * 3), folder / camera.name)
        photos.append(Photo(camera, folder / camera.name))
    return Capture("photographs", tuple(photos), None)


def measured(folder: Path, capture: Capture) -> tuple[Capture, list[str]]:
    said: list[str] = []
    settings: Any = PosesSettings(marker_size=EDGE)
    job = Job(settings=settings, out=folder / "out", work=folder / "work", source=folder)
    return with_markers(job, capture, EDGE, said.append), said


def grown(before: Capture, after: Capture) -> float:
    apart = [float(np.linalg.norm(each.photos[0].camera.centre - each.photos[3].camera.centre)) for each in (before, after)]
    return apart[1] / apart[0]


@pytest.mark.parametrize(("dictionary", "blur"), [("APRILTAG_36h11", 0.5), ("APRILTAG_36h11", 2.0), ("4X4_50", 1.2)])
def test_markers_give_metres_and_up(tmp_path: Path, dictionary: str, blur: float) -> None:
    points = SparsePoints(np.ones((1, 3)), np.zeros((1, 3), np.uint8), np.zeros(1), ())
    capture = replace(capture_of(tmp_path, dictionary, blur=blur), points=points, bounds=np.array([[-1.0] * 3, [1.0] * 3]))
    capture = replace(capture, photos=tuple(replace(photo, near=1.0, far=None) for photo in capture.photos))
    found, said = measured(tmp_path, capture)
    facts: Any = found.facts["markers"]
    ratio = grown(capture, found) / UNIT
    assert found.metric
    assert said == []
    assert facts["used"] == [0, 1, 2, 3]
    assert abs(ratio - 1) < min(0.005, facts["error"])
    assert found.points is not None
    assert found.bounds is not None
    np.testing.assert_allclose([found.points.xyz[0, 0], found.bounds[1, 2], found.photos[0].near], ratio * UNIT, rtol=1e-9)
    assert np.array(facts["normal"]) @ TRUE_UP > np.cos(np.radians(min(1.0, facts["normal_error"])))


def test_the_origin_is_on_the_first_marker_where_nothing_else_states_a_frame(tmp_path: Path) -> None:
    capture = capture_of(tmp_path)
    found, _ = measured(tmp_path, capture)
    np.testing.assert_allclose(found.facts["markers"]["normal"], [0, 0, 1], atol=1e-12)  # type: ignore[index]
    side = np.cross(TRUE_UP, [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    axes = np.stack([side, np.cross(TRUE_UP, side), TRUE_UP])
    for before, after in zip(capture.photos, found.photos, strict=True):
        np.testing.assert_allclose(after.camera.centre, axes @ before.camera.centre * UNIT - [*PLACES[0], 0], atol=0.005)


def test_one_that_moves_is_left_out_and_if_most_move_the_source_is_refused(tmp_path: Path) -> None:
    capture = capture_of(tmp_path, moving=(2,))
    found, said = measured(tmp_path, capture)
    ratio = grown(capture, found) / UNIT
    assert abs(ratio - 1) < 0.005
    assert "markers 2 moved" in said[0]
    with pytest.raises(BadInput):
        measured(tmp_path, capture_of(tmp_path, moving=(0, 1, 3)))


def test_markers_of_two_sizes_are_refused_and_none_leave_lengths_without_a_unit(tmp_path: Path) -> None:
    with pytest.raises(BadInput):
        measured(tmp_path, capture_of(tmp_path, sizes=(1, 1, 1, 1.2)))
    found, said = measured(tmp_path, capture_of(tmp_path, "APRILTAG_16h5"))
    assert not found.metric
    assert "no marker is seen" in said[0]
    assert "enerf board" in said[0]
    assert "--known-length" in said[0]


def test_how_sure_the_cameras_are_is_in_the_error_and_lengths_that_they_do_not_determine_are_none(tmp_path: Path) -> None:
    capture, rng = capture_of(tmp_path), np.random.default_rng(0)
    xyz = rng.uniform(-0.5, 0.5, (60, 3))
    points = SparsePoints(xyz, np.zeros((60, 3), np.uint8), np.zeros(60), (tuple(range(len(capture.photos))),) * 60)
    errors = []
    for miss in (0.5, 2.0):
        found, _ = measured(tmp_path, replace(capture, points=points, reprojection_error=miss))
        errors.append(found.facts["markers"]["error"])  # type: ignore[index]
    alone = measured(tmp_path, capture)[0].facts["markers"]["error"]  # type: ignore[index]
    np.testing.assert_allclose((errors[1] ** 2 - alone**2) / (errors[0] ** 2 - alone**2), 16.0)
    for unsure, miss in ((points, 30.0), (replace(points, tracks=((),) * 60), 0.0)):
        found, said = measured(tmp_path, replace(capture, points=unsure, reprojection_error=miss))
        assert not found.metric
        assert "only, and are not used" in said[0]
