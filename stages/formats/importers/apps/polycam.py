"""Polycam's raw data (developer mode): keyframes/ with images, cameras, and their corrected versions.

Layout: the README of PolyCam/polyform. A file of keyframes/cameras or corrected_cameras is named as its image and holds fx fy cx cy width height and the rows
t_00 ... t_23 of camera to world, with x right, y up, looking along -z; the world is ARKit's: y up, metres. Corrected cameras belong to corrected images, which
are undistorted; the two kinds share no frame and are not mixed. depth/ holds the sensor's millimetres, confidence/ 0, 127 or 255.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from efficientnerf.geometry.cameras import Camera, pose_from_opengl
from pipeline.errors import BadInput
from stages.formats.importers import frames, lenses
from stages.formats.importers.brown import brown_camera
from stages.formats.importers.depth import DepthFile, depth_file, with_depth
from stages.formats.importers.source import ImportSettings, Source, images_in
from stages.io.capture import Capture
from stages.io.json_file import finite, read_json, shown

KEYFRAMES = "keyframes"
LARGEST_CAMERA = 1 << 20  # bytes
MILLIMETRE = 0.001  # metres
HIGH = 255  # confidence; 127 is medium
FARTHEST = 5.0  # metres, the range of the sensor
_KINDS = (("corrected_images", "corrected_cameras"), ("images", "cameras"))
_AGAIN = "Export the raw data again."


def recognises(folder: Path, allow_outside: bool = False) -> bool:
    source = Source(folder, allow_outside)
    return any(_cameras(source, cameras) for _, cameras in _KINDS)


def files(folder: Path, settings: ImportSettings) -> list[Path]:
    """The camera files, their images and masks."""
    source = Source(folder, settings.allow_outside)
    images, cameras = _kind(source)
    found = frames.files_of(source, _frames(source, images, cameras))
    maps = [_depth(source, path.stem) for path in found]
    beside = [path for one in maps if one is not None for path in (one.file, one.confidence) if path is not None]
    return [*_cameras(source, cameras), *found, *beside]


def read(folder: Path, settings: ImportSettings) -> Capture:
    """The capture that the keyframes describe. Raises BadInput."""
    source = Source(folder, settings.allow_outside)
    images, cameras = _kind(source)
    warnings = []
    if cameras == "cameras":
        warnings.append("keyframes/corrected_cameras is not there: the phone's own poses and images with some distortion are used. Process with loop closure.")
    posed = {path.stem for path in _cameras(source, cameras)}
    unposed = [source.name_of(path) for path in images_in(source.root / KEYFRAMES / images) if path.stem not in posed]
    capture = frames.capture_of(
        source,
        _frames(source, images, cameras),
        settings,
        kind="polycam",
        where=f"{KEYFRAMES}/{cameras}",
        rejected=[(name, "without a camera file") for name in unposed],
        warnings=warnings,
        up=np.array([0.0, 1.0, 0.0]),
        metric=True,
        facts={"cameras": cameras},
    )
    return with_depth(capture, lambda photo: _depth(source, photo.image.stem))


def _depth(source: Source, stem: str) -> DepthFile | None:
    place = source.root / KEYFRAMES
    return depth_file(source, place / f"depth/{stem}.png", MILLIMETRE, place / f"confidence/{stem}.png", HIGH, FARTHEST)


def _cameras(source: Source, name: str) -> list[Path]:
    place = source.root / KEYFRAMES / name
    return sorted(source.check_inside(path) for path in place.glob("*.json") if path.is_file()) if place.is_dir() else []


def _kind(source: Source) -> tuple[str, str]:
    """The folders of images and of cameras that are used."""
    for images, cameras in _KINDS:
        if _cameras(source, cameras) and images_in(source.root / KEYFRAMES / images):
            return images, cameras
    raise BadInput(
        f"{source.root}: no raw data of Polycam: expected {KEYFRAMES}/images with {KEYFRAMES}/cameras, or their corrected versions. Choose a format with --as."
    )


def _frames(source: Source, images: str, cameras: str) -> list[frames.Frame]:
    listed = []
    found = _cameras(source, cameras)
    frames.check_count(len(found), f"{KEYFRAMES}/{cameras}")
    for path in found:
        listed.append(frames.Frame(path.stem, source.root / KEYFRAMES / images, source.name_of(path), frames.stated(_camera(source, path)), bare=True))
    return listed


def _camera(source: Source, path: Path) -> Camera:
    where = source.name_of(path)
    document = read_json(source.real(path), _AGAIN, limit=LARGEST_CAMERA)
    if not isinstance(document, dict):
        raise BadInput(f"{where}: {shown(document)}; expected an object. {_AGAIN}")

    def value(key: str) -> float:
        found = finite(document.get(key))
        if found is None:
            raise BadInput(f"{where}: {key} is {shown(document.get(key))}, expected a finite number. {_AGAIN}")
        return found

    width, height = value("width"), value("height")
    if width != int(width) or height != int(height) or not (0 < min(width, height) <= max(width, height) <= 65535):
        raise BadInput(f"{where}: image size {width:g}x{height:g}; expected whole pixels. {_AGAIN}")
    rows = [[value(f"t_{row}{column}") for column in range(4)] for row in range(3)]
    pose = pose_from_opengl(lenses.rigid([*rows, [0, 0, 0, 1]], where))
    lens = brown_camera("", (int(width), int(height)), (value("fx"), value("fy")), (value("cx"), value("cy")), (), (0, 0), where)
    return replace(lens, world_from_camera=pose)
