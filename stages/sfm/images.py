"""Copies of the photographs that COLMAP reads: after EXIF rotation, at working size, with their masks; decoded once for all searches of a stage."""

import hashlib
import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path, PurePosixPath
from typing import TypedDict, Unpack

import numpy as np

from pipeline.files import SafePoint, open_plain, remove, write_atomically
from stages.cores import in_order
from stages.io.photo import read_mask_file
from stages.io.pictures import UnreadableImage
from stages.io.png import FAST, read_png, write_png
from stages.io.reader import PhotoReader
from stages.scratch import opened
from stages.sfm.database import WorkImage

LAYOUT = 6  # of the work folder; raise it when what is written there changes meaning

Progress = Callable[..., None]


class Callables(TypedDict):
    """Callbacks of long work: how far it is, whether to go on, and what the user should know."""

    progress: Progress
    safe_point: SafePoint
    warn: Callable[..., None]


Masks = Mapping[str, Path | None]  # file of the mask of each photograph that has one; None: what is transparent is used, too
NO_MASK = "whole"  # in the place of the digest of a mask


def _sha256(path: Path) -> str:
    """Of a plain file, or the reason why it is unreadable. A pipe would block."""
    try:
        with open(open_plain(path), "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        return str(error.strerror)


def prepare_images(
    paths: Mapping[str, Path], *, max_side: int, features: int, seed: int, masks: Masks, lens: str = "auto", threads: int = 1, work: Path,
    copies: Path | None = None, **callables: Unpack[Callables],
) -> tuple[list[WorkImage], list[tuple[str, str]]]:
    """Copies of the photographs in `work/images` after EXIF rotation, longest side at most `max_side`; without those that cannot be read.

    masks    of some or all names; None: the photograph as a whole, whatever its alpha channel says
    copies   folder that others read photographs of the stage from (`PhotoReader`); None: one in the work folder
    returns  the copies in sorted order of name, and (name, reason) of each photograph left out

    What an earlier, killed call with the same photographs and settings left in `work` is kept, anything else there is removed.
    """
    safe_point, warn, reader = callables["safe_point"], callables["warn"], PhotoReader(copies or work / "photographs")
    request: dict[str, object] = {"layout": LAYOUT, "max_side": max_side, "features": features, "seed": seed, "lens": lens}
    rows: list[list[str | None]] = []
    ordered = sorted(paths)
    for name in ordered:
        safe_point()
        mask = masks.get(name)
        rows.append([name, _sha256(paths[name]), _sha256(mask) if mask is not None else NO_MASK if name in masks else None])
    request["photographs"] = rows
    # The work folder is emptied, unless it is of this very request.
    whole, record, parts = json.dumps(request, indent=1, sort_keys=True).encode(), work / "request.json", (work / "images", work / "masks")
    work.mkdir(parents=True, exist_ok=True)
    if not _holds(record, whole) or any(part.is_symlink() or not part.is_dir() for part in parts):
        for entry in list(work.iterdir()):
            remove(entry)
        for part in parts:
            part.mkdir()
        write_atomically(record, whole, durable=False)
    copied = in_order(
        lambda index: _copy(ordered[index], paths[ordered[index]], index, max_side, masks, lens, work, reader), range(len(ordered)), threads, safe_point
    )
    images: list[WorkImage] = []
    rejected: list[tuple[str, str]] = []
    for index, (name, (image, remark)) in enumerate(zip(ordered, copied, strict=True)):
        if image is None:
            rejected.append((name, remark))
            warn(f"{name}: {remark}; left out.")
        else:
            if remark:
                warn(f"{name}: {remark}")
            images.append(image)
        callables["progress"](index + 1, len(paths), "reading photographs")
    return images, rejected


def _copy(name: str, path: Path, index: int, max_side: int, masks: Masks, lens: str, work: Path, reader: PhotoReader) -> tuple[WorkImage | None, str]:
    """The copy of one photograph, None where it is unreadable; and a remark, or the reason."""
    try:
        photo = reader.photo(path, max_side)
    except UnreadableImage as error:
        return None, str(error)
    details, file = photo.details, f"{index:05d}.png"
    remove(work / "images" / file)  # a link there would be followed
    shutil.copyfile(photo.image, work / "images" / file)  # no hard link: a run that was killed here has to be resumed, and what is linked is refused
    mask, remark = None if photo.opaque is None else read_png(photo.opaque) > 0, ""
    if (mask_path := masks.get(name)) is None:
        mask = None if name in masks else mask
    else:
        try:
            given = read_mask_file(mask_path, details)
            mask = given if mask is None else mask & given
        except UnreadableImage as error:
            remark = f"its mask is not used: {error}"
    target = work / "masks" / f"{file}.png"
    if mask is None:
        remove(target)  # which `extract_features` may have written
    else:
        write_png(np.where(mask, np.uint8(255), np.uint8(0)), target, compress_level=FAST, durable=False)
    focal = details.focal
    # Nothing tells the cameras of photographs without EXIF data apart but the folder, or of several sources the source, that they are in.
    maker = details.maker if details.maker or focal else PurePosixPath(name).parts[0] if "/" in name else ""
    fisheye = lens == "fisheye" or (lens == "auto" and details.fisheye)
    key = f"{details.width}x{details.height} {maker} {focal if focal is None else round(focal, 1)}{' fisheye' if fisheye else ''}"
    return WorkImage(name, file, details.width, details.height, details.work_width, details.work_height, focal, key, fisheye), remark


def _holds(path: Path, data: bytes) -> bool:
    """Whether a plain file has exactly this content."""
    try:
        with opened(path) as file:
            return file.read(len(data) + 1) == data
    except OSError:
        return False
