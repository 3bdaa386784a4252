"""A white backdrop is left out where nothing contradicts it, and what does: points in it, silhouettes that do not agree, texture."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from efficientnerf.geometry.cameras import project
from stages.framing.scene_bounds import in_view
from stages.io.capture import Capture, Photo, Silhouettes, SparsePoints
from stages.io.png import read_png, write_png
from stages.io.reader import PhotoReader
from stages.masking.backdrop import without_white_backdrop
from stages.masking.photographs import mask_choice
from stages.poses.settings import PosesSettings
from tests.stages import captures, turntables

COUNT = 14
WHITE = np.full((turntables.HEIGHT, turntables.WIDTH, 3), 235.0)
RULER = (slice(200, 225), 60)  # rows; columns


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """A cube before white, seen all round, with a ruler that lies elsewhere in each photograph; cameras, and points on the cube."""
    folder = tmp_path_factory.mktemp("white")
    photos = []
    for number, camera in enumerate(turntables.cameras(COUNT)):
        picture = np.minimum(turntables.picture(camera, number, wall=WHITE), np.uint8(240))
        inside = cube(camera)
        at = 11 * number
        picture[RULER[0], at : at + RULER[1]][~inside[RULER[0], at : at + RULER[1]]] = 40
        write_png(picture, folder / camera.name)
        photos.append(Photo(camera, folder / camera.name))
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-1, 1, (800, 3))
    xyz *= turntables.HALF / np.abs(xyz).max(axis=1, keepdims=True)
    return Capture("photographs", tuple(photos), None, points=points_at(xyz, photos))


def points_at(xyz: np.ndarray, photos: list[Photo]) -> SparsePoints:
    visible = in_view(xyz, [photo.camera for photo in photos])
    tracks = tuple(tuple(np.flatnonzero(column)[:4].tolist()) for column in visible.T)
    return SparsePoints(xyz, np.zeros((len(xyz), 3), np.uint8), np.full(len(xyz), 0.5), tracks)


def cube(camera: turntables.Camera) -> np.ndarray:
    """(h, w) bool: what a camera shows of it."""
    corners = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]) * turntables.HALF
    drawn = np.zeros((turntables.HEIGHT, turntables.WIDTH), np.uint8)
    cv2.fillConvexPoly(drawn, cv2.convexHull(np.round(project(camera, corners)[0]).astype(np.int32)), 1)
    return drawn > 0


def judged(capture: Capture, folder: Path) -> Capture:
    job = captures.poses_job(folder, folder)
    paths = {photo.camera.name: photo.image for photo in capture.photos}
    return without_white_backdrop(job, capture, paths, PhotoReader(folder / "photographs"), job.warn)


def test_the_subject_is_kept_and_what_moved_next_to_it_is_not(capture: Capture, tmp_path: Path) -> None:
    found = judged(capture, tmp_path)
    assert found.provenance.background == "white"
    assert mask_choice(PosesSettings(), found.provenance) == "silhouette"
    for photo in found.photos:
        assert photo.mask is not None
        mask, true = read_png(photo.mask) > 127, cube(photo.camera)
        assert (mask & true).sum() >= 0.97 * true.sum()
        assert (mask & ~true).sum() <= 0.1 * true.sum()


@pytest.mark.parametrize("why", ["no points", "few points", "wrong cameras", "texture", "alpha"])
def test_nothing_is_left_out_without_evidence(capture: Capture, tmp_path: Path, why: str) -> None:
    assert capture.points is not None
    photos = list(capture.photos)
    points: SparsePoints | None = capture.points
    if why == "no points":
        points = None
    elif why == "few points":
        points = capture.points.only(np.arange(100))
    elif why == "wrong cameras":
        turned = [*photos[5:], *photos[:5]]
        photos = [replace(photo, camera=replace(other.camera, world_from_camera=photo.camera.world_from_camera @ np.diag([-1.0, -1, 1, 1])))
                  for photo, other in zip(photos, turned, strict=True)]  # fmt: skip
    else:
        for number, photo in enumerate(photos):
            picture = turntables.picture(photo.camera, number) if why == "texture" else np.dstack([read_png(photo.image), 255 * cube(photo.camera)])
            write_png(picture.astype(np.uint8), tmp_path / photo.camera.name)
            photos[number] = replace(photo, image=tmp_path / photo.camera.name)
    given = replace(capture, photos=tuple(photos), points=points)
    assert judged(given, tmp_path) is given
    assert given.silhouettes == Silhouettes()
