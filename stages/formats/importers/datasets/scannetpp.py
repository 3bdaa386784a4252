"""ScanNet++'s DSLR captures, and those made likewise: nerfstudio/transforms.json (or transforms_undistorted.json) with images in a folder beside it.

Layout: the documentation of ScanNet++ ("dslr") and the reader of nerfstudio (scannetpp_dataparser). The file has nerfstudio's frames, and `test_frames` of
the same kind; names are those of files in resized_images/ (undistorted: resized_undistorted_images/), masks in resized_anon_masks/; train_test_lists.json
beside overrules which are test images. Frames with `is_bad` are left out. The fisheye lens (OPENCV_FISHEYE) is traced as it is. The world has z up, in
metres.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.geometry.cameras import Camera
from pipeline.errors import BadInput
from pipeline.text import printable
from stages.formats.importers import frames
from stages.formats.importers.source import ImportSettings, Source
from stages.formats.importers.transforms import read_document
from stages.formats.importers.transforms_camera import lens_of, pose_of
from stages.io.capture import Capture
from stages.io.json_file import read_json, shown

PLACES = (".", "dslr")
FILES = {  # file -> folders of images and of masks
    "nerfstudio/transforms.json": (("resized_images", "images", "original_images"), ("resized_anon_masks", "masks")),
    "nerfstudio/transforms_undistorted.json": (("resized_undistorted_images", "undistorted_images"), ("resized_undistorted_masks", "undistorted_anon_masks")),
}
LISTS = "train_test_lists.json"
_AGAIN = "Download the capture again, or choose another format with --as."


def recognises(folder: Path, allow_outside: bool = False) -> bool:
    return _file(Source(folder, allow_outside)) is not None


def files(folder: Path, settings: ImportSettings) -> list[Path]:
    """The lists, the images and their masks."""
    source = Source(folder, settings.allow_outside)
    base, file, listed, _ = _read(source)
    lists = [base / LISTS] if (base / LISTS).is_file() else []
    return [file, *lists, *frames.files_of(source, listed)]


def read(folder: Path, settings: ImportSettings) -> Capture:
    """The capture that the lists describe. Raises BadInput."""
    source = Source(folder, settings.allow_outside)
    _, file, listed, bad = _read(source)
    rejected = [(name, "marked as bad by the data set") for name in bad]
    up = np.array([0.0, 0.0, 1.0])
    return frames.capture_of(source, listed, settings, kind="scannetpp", where=source.name_of(file), rejected=rejected, up=up, metric=True)


def _file(source: Source) -> tuple[Path, str] | None:
    """The folder of the capture and the list of it whose images are there, else the first list."""
    found = []
    for place in PLACES:
        for name, (folders, _) in FILES.items():
            if (source.root / place / name).is_file():
                source.real(source.root / place / name)
                found.append((any((source.root / place / folder).is_dir() for folder in folders), source.root / place, name))
    best = next((one for one in found if one[0]), found[0] if found else None)
    return None if best is None else best[1:]


def _read(source: Source) -> tuple[Path, Path, list[frames.Frame], list[str]]:
    """The folder of the capture, the list of frames, the frames, and the images that the data set marks as bad."""
    found = _file(source)
    if found is None:
        raise BadInput(f"{source.root}: no capture of ScanNet++: expected {' or '.join(FILES)}, here or in dslr/. Choose another format with --as.")
    base, name = found
    file, where = base / name, source.name_of(base / name)
    document = read_document(source.real(file))
    images = next((base / folder for folder in FILES[name][0] if (base / folder).is_dir()), base)
    masks = next((base / folder for folder in FILES[name][1] if (base / folder).is_dir()), base)
    more = document.get("test_frames", [])
    if not isinstance(more, list):
        raise BadInput(f"{where}: test_frames is {shown(more)}; expected a list. {_AGAIN}")
    entries = [*((entry, "train" if more else None) for entry in document["frames"]), *((entry, "test") for entry in more)]
    frames.check_count(len(entries), where)
    splits = _lists(source, base)
    listed, bad = [], []
    for index, (entry, split) in enumerate(entries):
        if not isinstance(entry, dict) or not isinstance(entry.get("file_path"), str):
            raise BadInput(f"{where}: frame {index} has no `file_path`. {_AGAIN}")
        image = entry["file_path"]
        if entry.get("is_bad") is True:
            bad.append(printable(image, frames.MAX_NAME))
            continue
        mask = source.find(entry["mask_path"], masks).path if isinstance(entry.get("mask_path"), str) else None
        place = f"{where}: frame {index} ({printable(image, frames.MAX_NAME)})"
        listed.append(frames.Frame(image, images, place, _camera(document, entry, place), mask=mask, split=splits.get(image, split)))
    return base, file, listed, bad


def _camera(document: dict[str, Any], entry: dict[str, Any], where: str) -> Callable[[str, tuple[int, int]], Camera]:
    pose = pose_of(entry, where)
    return lambda name, size: lens_of(document | entry, name, size, pose, where)


def _lists(source: Source, base: Path) -> dict[str, str]:
    """Image -> split, where the capture lists them."""
    path = base / LISTS
    if not path.is_file():
        return {}
    document = read_json(source.real(path), _AGAIN)
    splits: dict[str, str] = {}
    for split in ("train", "test"):
        names = document.get(split, []) if isinstance(document, dict) else None
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise BadInput(f"{source.name_of(path)}: {split} is no list of names. {_AGAIN}")
        splits |= dict.fromkeys(names, split)
    return splits
