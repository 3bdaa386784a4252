"""Polycam's raw data (developer mode): keyframes/ with images, cameras, and their corrected versions.

Layout: the README of PolyCam/polyform. A file of keyframes/cameras or corrected_cameras is named as its image and holds fx fy cx cy width height and the rows
t_00 ... t_23 of camera to world, with x right, y up, looking along -z; the world is ARKit's: y up, metres. Corrected cameras belong to corrected images, which
are undistorted; the two kinds share no frame and are not mixed. depth/ holds the sensor's millimetres, confidence/ 0, 127 or 255.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from efficientnerf.geometry.cameras import Camera, pose_from_opengl
from pipeline.errors import BadInput
from stages.formats.importers import lenses
from stages.formats.importers.brown import brown_camera
from stages.formats.importers.depth import MILLIMETRE, SENSOR_RANGE, DepthFile, depth_file
from stages.formats.importers.frames import Frame, check_count, stated
from stages.formats.importers.listed import Y_UP, Listed, ListFormat
from stages.formats.importers.source import Source, images_in
from stages.io.json_file import number, read_object

KEYFRAMES = "keyframes"
EXPECTED = f"{KEYFRAMES}/images with {KEYFRAMES}/cameras, or their corrected versions"
LARGEST_CAMERA = 1 << 20  # bytes
HIGH = 255  # confidence; 127 is medium
_KINDS = (("corrected_images", "corrected_cameras"), ("images", "cameras"))
_AGAIN = "Export the raw data again."


def _signs(source: Source) -> Sequence[Path]:
    return next((found for _, cameras in _KINDS if (found := _cameras(source, cameras))), [])


def _listed(source: Source, signs: Sequence[Path]) -> Listed:
    images, cameras = _kind(source)
    where, found = f"{KEYFRAMES}/{cameras}", _cameras(source, cameras)
    raw = "keyframes/corrected_cameras is not there: the phone's own poses and images with some distortion are used. Process with loop closure."
    posed, place = {path.stem for path in found}, source.root / KEYFRAMES / images
    check_count(len(found), where)
    return Listed(
        where,
        [Frame(path.stem, place, source.name_of(path), stated(_camera(source, path)), bare=True) for path in found],
        found,
        rejected=[(source.name_of(path), "without a camera file") for path in images_in(place) if path.stem not in posed],
        warnings=[raw] if cameras == "cameras" else [],
        up=Y_UP,
        metric=True,
        facts={"cameras": cameras},
        depth=partial(_depth, source),
    )


def _depth(source: Source, frame: Frame, image: Path) -> DepthFile | None:
    place = source.root / KEYFRAMES
    return depth_file(source, place / f"depth/{image.stem}.png", MILLIMETRE, place / f"confidence/{image.stem}.png", HIGH, SENSOR_RANGE)


def _cameras(source: Source, name: str) -> list[Path]:
    place = source.root / KEYFRAMES / name
    return sorted(source.check_inside(path) for path in place.glob("*.json") if path.is_file()) if place.is_dir() else []


def _kind(source: Source) -> tuple[str, str]:
    """The folders of images and of cameras that are used."""
    for images, cameras in _KINDS:
        if _cameras(source, cameras) and images_in(source.root / KEYFRAMES / images):
            return images, cameras
    raise BadInput(f"{source.root}: no raw data of Polycam: expected {EXPECTED}. Choose another format with --as.")


def _camera(source: Source, path: Path) -> Camera:
    where = source.name_of(path)
    document = read_object(source.real(path), where, _AGAIN, limit=LARGEST_CAMERA)
    value = partial(number, document, where=where, remedy=_AGAIN)
    size = lenses.image_size(value("width"), value("height"), where, _AGAIN)
    rows = [[value(f"t_{row}{column}") for column in range(4)] for row in range(3)]
    pose = pose_from_opengl(lenses.rigid([*rows, [0, 0, 0, 1]], where))
    return brown_camera("", size, (value("fx"), value("fy")), (value("cx"), value("cy")), pose, where)


FORMAT = ListFormat("polycam", EXPECTED, _signs, _listed)
