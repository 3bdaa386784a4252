"""MVSNet's cameras: one text file an image, <number>_cam.txt, in the layouts of MVSNet itself, BlendedMVS, Tanks and Temples, and DTU.

Layout: the README of YoYo000/MVSNet and that of BlendedMVS. `extrinsic` is world to camera, x right, y down, z forward; `intrinsic` is K; the depth range that
follows is that of their networks' search, and not used.

    cams/ or cams_1/   images/, blended_images/ (not the _masked ones) or another folder with <number>.jpg or .png
    Cameras/           DTU: Rectified/<one scan>/rect_<number + 1>_<light>_r5000.png; of several lights the fourth, of which each view has one, is taken
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from pipeline.errors import BadInput
from stages.formats.importers import frames
from stages.formats.importers.datasets.matrices import from_world, pinhole_frame
from stages.formats.importers.source import ImportSettings, Source
from stages.formats.importers.texts import numbers, read_text
from stages.io.capture import Capture

PLACES = ("cams", "cams_1", "cam", "Cameras", "Cameras/train")
IMAGES = ("images", "blended_images", "image", "rgb", ".")
LIGHT = 3  # of DTU's seven, an even one
LARGEST_FILE = 1 << 16  # bytes
_AGAIN = "Write the data set again, or choose another format with --as."


def recognises(folder: Path, allow_outside: bool = False) -> bool:
    return bool(_cameras(Source(folder, allow_outside)))


def files(folder: Path, settings: ImportSettings) -> list[Path]:
    """The camera files, the images and their masks."""
    source = Source(folder, settings.allow_outside)
    return [*_cameras(source).values(), *frames.files_of(source, _frames(source))]


def read(folder: Path, settings: ImportSettings) -> Capture:
    """The capture that the camera files describe. Raises BadInput."""
    source = Source(folder, settings.allow_outside)
    listed = _frames(source)
    place = source.name_of(next(iter(_cameras(source).values())).parent)
    return frames.capture_of(source, listed, settings, kind="mvsnet", where=place, facts={"cameras": place})


def _cameras(source: Source) -> dict[int, Path]:
    """Number -> camera file, of the first of the usual folders that holds any."""
    for place in PLACES:
        folder = source.root / place
        found = {}
        for path in sorted(folder.glob("*_cam.txt")) if folder.is_dir() else ():
            match = re.fullmatch(r"([0-9]{1,9})_cam\.txt", path.name)
            if match and path.is_file():
                found[int(match[1])] = source.check_inside(path)
        if found:
            return dict(sorted(found.items()))
    return {}


def _frames(source: Source) -> list[frames.Frame]:
    cameras = _cameras(source)
    if not cameras:
        raise BadInput(f"{source.root}: no cameras of MVSNet: expected cams/00000000_cam.txt and so on. Choose another format with --as.")
    frames.check_count(len(cameras), f"{next(iter(cameras.values())).parent.name}")
    scan = _scan(source)
    listed = []
    for number, path in cameras.items():
        where, stem = source.name_of(path), path.name.removesuffix("_cam.txt")
        lens, pose = read_camera(source.real(path), where)
        if scan is None:
            beside = next((source.root / place for place in IMAGES if source.find(stem, source.root / place).how == "listed"), source.root)
            listed.append(frames.Frame(stem, beside, where, pinhole_frame(lens, pose, where), bare=True))
        else:
            listed.append(frames.Frame(f"rect_{number + 1:03d}_{LIGHT}_r5000.png", scan, where, pinhole_frame(lens, pose, where)))
    return listed


def _scan(source: Source) -> Path | None:
    """The one scan of a folder of DTU; None: it is no such folder. Raises BadInput for several."""
    rectified = source.root / "Rectified"
    scans = [path for path in sorted(rectified.iterdir()) if path.is_dir()] if rectified.is_dir() else []
    if len(scans) > 1:
        raise BadInput(f"{rectified}: {len(scans)} scans; one is read. Copy Cameras/ and Rectified/<scan> of one of them into a folder.")
    return scans[0] if scans else None


def read_camera(path: Path, where: str) -> tuple[np.ndarray, np.ndarray]:
    """K (3, 3) and the pose (4, 4), camera to world, of a file. Raises BadInput."""
    found = read_text(path, LARGEST_FILE).split()
    if len(found) < 27 or found[0] != "extrinsic" or found[17] != "intrinsic":
        raise BadInput(f"{where}: expected `extrinsic` with 16 numbers and `intrinsic` with 9. {_AGAIN}")
    pose = from_world(numbers(found[1:17], 16, f"{where}: extrinsic").reshape(4, 4), f"{where}: extrinsic")
    return numbers(found[18:27], 9, f"{where}: intrinsic").reshape(3, 3), pose
