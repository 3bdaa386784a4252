"""NSVF's layout: intrinsics.txt, pose/<name>.txt, rgb/<name>.png.

Layout: the README of facebookresearch/NSVF and its data sets. A pose is camera to world, x right, y down, z forward. intrinsics.txt holds a 4x4 or 3x3
matrix, or "f cx cy 0" first and the image's height and width last. Where names begin with 0_, 1_ and 2_, these are training, validation and test images;
without 2_, those with 1_ are test images. bbox.txt holds the corners of the box round the object, and the size of its voxels.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.errors import BadInput
from stages.formats.importers import frames, lenses
from stages.formats.importers.datasets.matrices import pinhole_frame
from stages.formats.importers.source import ImportSettings, Source
from stages.formats.importers.texts import numbers, read_text
from stages.io.capture import Capture

INTRINSICS, POSES, BOX = "intrinsics.txt", "pose", "bbox.txt"
IMAGES = ("rgb", "images", "image", "color")
LARGEST_FILE = 1 << 16  # bytes
_AGAIN = "Write the data set again, or choose another format with --as."


def recognises(folder: Path, allow_outside: bool = False) -> bool:
    source = Source(folder, allow_outside)
    return (folder / INTRINSICS).is_file() and source.real(folder / INTRINSICS).is_file() and bool(_poses(source))


def files(folder: Path, settings: ImportSettings) -> list[Path]:
    """Intrinsics, poses, the box, the images and their masks."""
    source = Source(folder, settings.allow_outside)
    box = [folder / BOX] if (folder / BOX).is_file() else []
    return [folder / INTRINSICS, *box, *_poses(source), *frames.files_of(source, _frames(source))]


def read(folder: Path, settings: ImportSettings) -> Capture:
    """The capture that the files describe. Raises BadInput."""
    source = Source(folder, settings.allow_outside)
    return frames.capture_of(source, _frames(source), settings, kind="nsvf", where=POSES, bounds=_bounds(source))


def _poses(source: Source) -> list[Path]:
    place = source.root / POSES
    return sorted(source.check_inside(path) for path in place.glob("*.txt") if path.is_file()) if place.is_dir() else []


def _bounds(source: Source) -> np.ndarray | None:
    path = source.root / BOX
    if not path.is_file():
        return None
    found = read_text(source.real(path), LARGEST_FILE).split()
    box = numbers(found[:6], 6, BOX).reshape(2, 3)
    if not (box[0] < box[1]).all():
        raise BadInput(f"{BOX}: {box.tolist()}; expected the lower corner, then the upper one. {_AGAIN}")
    return box


def intrinsics(path: Path) -> tuple[np.ndarray, tuple[int, int] | None]:
    """K (3, 3), and (width, height) where the file states it. Raises BadInput."""
    found, where = read_text(path, LARGEST_FILE).split(), path.name
    if len(found) in (9, 16):
        side = 3 if len(found) == 9 else 4
        return numbers(found, len(found), where).reshape(side, side)[:3, :3], None
    if len(found) == 4:
        fx, fy, cx, cy = numbers(found, 4, where)
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), None
    if len(found) < 6:
        raise BadInput(f"{where}: {len(found)} numbers; expected a matrix of 3x3 or 4x4, fx fy cx cy, or f cx cy first and height, width last. {_AGAIN}")
    focal, cx, cy = numbers(found[:3], 3, where)
    height, width = numbers(found[-2:], 2, where)
    if not (0 < min(height, width) <= max(height, width) <= 65535 and height == int(height) and width == int(width)):
        raise BadInput(f"{where}: height and width {height:g}, {width:g}; expected the image size in whole pixels. {_AGAIN}")
    return np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1]]), (int(width), int(height))


def _frames(source: Source) -> list[frames.Frame]:
    poses = _poses(source)
    if not poses or not (source.root / INTRINSICS).is_file():
        raise BadInput(f"{source.root}: no data set of NSVF: expected {INTRINSICS} and {POSES}/<name>.txt. Choose another format with --as.")
    frames.check_count(len(poses), POSES)
    k, stated = intrinsics(source.real(source.root / INTRINSICS))
    beside = next((source.root / place for place in IMAGES if (source.root / place).is_dir()), source.root)
    splits = {"0_": "train", "1_": "val" if any(path.name.startswith("2_") for path in poses) else "test", "2_": "test"}
    split = splits if all(path.name[:2] in splits for path in poses) else {}
    listed = []
    for path in poses:
        where = source.name_of(path)
        found = read_text(source.real(path), LARGEST_FILE).split()
        pose = lenses.rigid(numbers(found, 16, where).reshape(4, 4), where)
        listed.append(frames.Frame(path.stem, beside, where, pinhole_frame(k, pose, INTRINSICS, stated), bare=True, split=split.get(path.name[:2])))
    return listed
