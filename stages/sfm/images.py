"""Copies of the photographs that COLMAP reads: after EXIF rotation, at working size, with their masks. Copies of a killed call are reused."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Annotated, TypedDict, Unpack

import msgspec
import numpy as np

from pipeline.files import SafePoint, open_plain, remove, write_atomically
from stages.cores import in_order
from stages.io.photo import DecodedPhoto, read_mask_file, read_photo
from stages.io.pictures import UnreadableImage
from stages.io.png import FAST, read_png, write_png
from stages.scratch import note, noted, once, opened

LAYOUT = 5  # of the work folder; raise it when what is written there changes meaning

Side = Annotated[int, msgspec.Meta(ge=1, le=2**20)]  # pixels
Progress = Callable[..., None]


class Callables(TypedDict):
    """Callbacks of long work: how far it is, whether to go on, and what the user should know."""

    progress: Progress
    safe_point: SafePoint
    warn: Callable[..., None]


Masks = Mapping[str, Path | None]  # file of the mask of each photograph that has one; None: what is transparent is used, too
WHOLE = "whole"  # in the place of the digest of a mask


@dataclass(frozen=True)
class WorkImage:
    """The copy of one photograph after EXIF rotation.

    name            of the photograph
    file            of the copy: numbers in sorted order of name
    width, height   of the photograph after EXIF rotation, pixels
    work_width, work_height  of the copy
    focal           pixels of the photograph, from its EXIF data, or None
    camera_key      photographs with equal keys share a COLMAP camera: same size, maker, focal length and kind of lens; without either same folder
    fisheye         whether it was taken through a fisheye lens
    """

    name: str
    file: str
    width: Side
    height: Side
    work_width: Side
    work_height: Side
    focal: Annotated[float, msgspec.Meta(gt=0)] | None
    camera_key: str
    fisheye: bool = False


def _sha256(path: Path) -> str:
    """Of a plain file, or the reason why it is unreadable. A pipe would block."""
    try:
        with open(open_plain(path), "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        return str(error.strerror)


def prepare_images(
    paths: Mapping[str, Path],
    *,
    max_side: int,
    features: int,
    seed: int,
    masks: Masks,
    lens: str = "auto",
    threads: int = 1,
    work: Path,
    **callables: Unpack[Callables],
) -> tuple[list[WorkImage], list[tuple[str, str]]]:
    """Copies of the photographs in `work/images` after EXIF rotation, longest side at most `max_side`; without those that cannot be read.

    paths    the file of each photograph, by name
    masks    of some or all names; None: the photograph as a whole, whatever its alpha channel says
    lens     "fisheye", "perspective", or "auto": fisheye where EXIF data say so
    threads  on which photographs are read
    returns  the copies in sorted order of name, and (name, reason) of each photograph left out

    What an earlier, killed call with the same photographs and settings left in `work` is kept, anything else there is removed.
    """
    safe_point, warn = callables["safe_point"], callables["warn"]
    request: dict[str, object] = {"layout": LAYOUT, "max_side": max_side, "features": features, "seed": seed, "lens": lens}
    request["photographs"] = _digests(paths, masks, safe_point)
    _begin(work, json.dumps(request, indent=1, sort_keys=True).encode())
    ordered, warn_once = sorted(paths), once(warn)
    known: list[Copy | None] = []
    for index, name in enumerate(ordered):
        safe_point()
        known.append(noted(_note_of(index, work), Copy, warn_once, partial(_check, name, index, max_side, work)))
    fresh = in_order(
        lambda index: _copy(ordered[index], paths[ordered[index]], index, max_side, masks, lens, work),
        [index for index, copied in enumerate(known) if copied is None],
        threads,
        safe_point,
    )
    images: list[WorkImage] = []
    rejected: list[tuple[str, str]] = []
    for index, (name, copied) in enumerate(zip(ordered, known, strict=True)):
        if copied is None:
            copied, outputs = next(fresh)
            note(_note_of(index, work), msgspec.to_builtins(copied), outputs)
        if copied.image is None:
            rejected.append((name, copied.remark))
            warn(f"{name}: {copied.remark}; left out.")
        else:
            if copied.remark:
                warn(f"{name}: {copied.remark}")
            images.append(copied.image)
        callables["progress"](index + 1, len(paths), "reading photographs")
    return images, rejected


def _begin(work: Path, request: bytes) -> None:
    """Empty the work folder, unless it is of this very request."""
    record, parts = work / "request.json", (work / "images", work / "masks")
    work.mkdir(parents=True, exist_ok=True)
    if not _holds(record, request) or any(part.is_symlink() or not part.is_dir() for part in parts):
        for entry in list(work.iterdir()):
            remove(entry)
        for part in parts:
            part.mkdir()
        write_atomically(record, request, durable=False)


def _note_of(index: int, work: Path) -> Path:
    return work / f"copy_{index:05d}.json"


def _digests(paths: Mapping[str, Path], masks: Masks, safe_point: SafePoint) -> list[list[str | None]]:
    rows: list[list[str | None]] = []
    for name in sorted(paths):
        safe_point()
        mask = masks.get(name)
        rows.append([name, _sha256(paths[name]), _sha256(mask) if mask is not None else WHOLE if name in masks else None])
    return rows


@dataclass(frozen=True)
class Copy:
    """The result of copying a photograph: its copy, or None where it is unreadable; a remark, or the reason."""

    image: WorkImage | None
    remark: str


def images_of(work: Path) -> Path:
    """The folder of the copies; for a step's own scratch folder, that of its parent."""
    here = work / "images"
    return here if here.is_dir() else work.parent / "images"


def _file(index: int) -> str:
    return f"{index:05d}.png"


def _copy(name: str, path: Path, index: int, max_side: int, masks: Masks, lens: str, work: Path) -> tuple[Copy, list[Path]]:
    """Copy one photograph; with the files written."""
    try:
        photo: DecodedPhoto = read_photo(path, max_side)
    except UnreadableImage as error:
        return Copy(None, str(error)), []
    outputs = [work / "images" / _file(index)]
    write_png(photo.rgb, outputs[0], compress_level=FAST, durable=False)
    mask, remark = photo.opaque, ""
    if (mask_path := masks.get(name)) is None:
        mask = None if name in masks else mask
    else:
        try:
            given = read_mask_file(mask_path, photo)
            mask = given if mask is None else mask & given
        except UnreadableImage as error:
            remark = f"its mask is not used: {error}"
    if mask is not None:
        outputs.append(work / "masks" / f"{_file(index)}.png")
        write_png(np.where(mask, np.uint8(255), np.uint8(0)), outputs[1], compress_level=FAST, durable=False)
    height, width = photo.rgb.shape[:2]
    focal = None if photo.focal is None else float(photo.focal)
    # Nothing tells the cameras of photographs without EXIF data apart but the folder, or of several sources the source, that they are in.
    maker = photo.maker if photo.maker or focal else PurePosixPath(name).parts[0] if "/" in name else ""
    key = f"{photo.width}x{photo.height} {maker} {focal if focal is None else round(focal, 1)}"
    fisheye = lens == "fisheye" or (lens == "auto" and photo.fisheye)
    key += " fisheye" if fisheye else ""
    return Copy(WorkImage(name, _file(index), photo.width, photo.height, width, height, focal, key, fisheye), remark), outputs


def _check(name: str, index: int, max_side: int, work: Path, copied: Copy, outputs: Collection[str]) -> None:
    """Raises where this is not what became of a photograph, or its copy and mask are not there at working size."""
    image = copied.image
    if image is None:
        return
    if (image.name, image.file) != (name, _file(index)) or max(image.work_width, image.work_height) > max_side:
        raise ValueError("of another photograph")
    for path in (work / "images" / image.file, work / "masks" / f"{image.file}.png"):
        there = path.relative_to(work).as_posix() in outputs
        if there and read_png(path).shape[:2] != (image.work_height, image.work_width):
            raise ValueError(f"{path.name} is of another size")
        if not there and path.parent.name == "images":
            raise ValueError(f"{path.name} is missing")
        if not there:
            remove(path)  # that of a photograph without a mask, of which only `extract_features` knows


def _holds(path: Path, data: bytes) -> bool:
    """Whether a plain file has exactly this content."""
    try:
        with opened(path) as file:
            return file.read(len(data) + 1) == data
    except OSError:
        return False
