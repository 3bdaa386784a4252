"""From a list of frames to a capture, for all importers of lists.

Frames name images. Missing images are looked for, one listed folder at a time: where nothing of a listed folder is found, the one folder of the source
with most of its names stands in for it (images/ listed, rgb/ there). A tie between two folders is not decided.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, Generic, TypeVar

import numpy as np

from efficientnerf.geometry.cameras import Camera
from pipeline.errors import BadInput
from pipeline.text import printable
from stages.formats.importers import lenses
from stages.formats.importers.masks import masks_of
from stages.formats.importers.photographs import NOT_PHOTOGRAPHS
from stages.formats.importers.source import (
    IMAGE_SUFFIXES,
    MAX_FRAMES,
    MIN_IMAGES,
    ImportSettings,
    Source,
    abbreviated,
    missing_images_warning,
    moved_images_warnings,
    name_key,
)
from stages.io.capture import Capture, Photo, SparsePoints
from stages.io.pictures import Header, UnreadableImage, read_header

MAX_NAME = 200  # characters of a listed name that are shown
USUAL_FOLDERS = ("images", "image", "rgb", "input", "photos", "color")  # which of several that hold a bare name is meant
_BESIDE_IMAGES = NOT_PHOTOGRAPHS | {"confidence"}  # folders with files of the names of images
REMEDY = "Copy them into the source folder, or export again without them."
SPLIT_ORDER = {"train": 0, "val": 1, "test": 2, None: 3}


@dataclass(frozen=True)
class Frame:
    """An image that a file lists.

    name    as listed, relative to the folder `beside`
    where   what messages call it
    camera  (name, (width, height) of the upright image) -> Camera, at the size that the file states or at that of the image
    bare    the format states no folder: the name alone is looked for, and its place is not reported
    mask    where the format names masks; else one next to the image is looked for
    """

    name: str
    beside: Path
    where: str
    camera: Callable[[str, tuple[int, int]], Camera]
    bare: bool = False
    mask: Path | None = None
    split: str | None = None


def stated(camera: Camera) -> Callable[[str, tuple[int, int]], Camera]:
    """For a frame: a camera whose size the file states."""
    return lambda name, size: replace(camera, name=name)


F = TypeVar("F", bound=Frame)


@dataclass
class Listing(Generic[F]):
    """Frames with the images that they led to.

    found       (frame, its image)
    missing     names, as they may be shown
    repeated    (name, reason) of those that name an image again
    places      (listed, found) of those found at another place
    extensions  (listed, found) of those with another extension
    """

    found: list[tuple[F, Path]] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    repeated: list[tuple[str, str]] = field(default_factory=list)
    places: list[tuple[str, str]] = field(default_factory=list)
    extensions: list[tuple[str, str]] = field(default_factory=list)


def check_count(count: int, where: str) -> None:
    """Raise BadInput for no frames, or more than are read."""
    if not count:
        raise BadInput(f"{where}: no cameras. At least {MIN_IMAGES} are needed.")
    if count > MAX_FRAMES:
        raise BadInput(f"{where}: {count} cameras; at most {MAX_FRAMES} are read.")


def relocated(source: Source, names: Sequence[str], present: Iterable[str], taken: set[Path], bare: bool = False) -> dict[str, Path]:
    """Listed name -> image, of missing names whose folders stand elsewhere in the source.

    names    that were not found
    present  listed names that were: their folders are where they are listed, and what is missing there is missing
    taken    images that other names led to
    bare     names without a folder: of several folders the usual one is taken
    """
    folders: dict[tuple[str, ...], list[str]] = {}
    for name in names:
        folders.setdefault(_parts(name)[:-1], []).append(name)
    there = set() if bare else {_parts(name)[:-1] for name in present}
    found: dict[str, Path] = {}
    for parts, listed in folders.items():
        if parts in there:
            continue
        images = _best_folder(source, listed, parts, taken, bare)
        found.update(images)
        taken |= set(images.values())
    return found


def _parts(name: str) -> tuple[str, ...]:
    return tuple(part for part in PurePosixPath(name.replace("\\", "/")).parts if part not in (".", "/"))


def _best_folder(source: Source, names: Sequence[str], parts: tuple[str, ...], taken: set[Path], bare: bool) -> dict[str, Path]:
    """Name -> image in the one folder that holds most of the names."""
    index = source.images_by_stem()
    by_folder: dict[Path, dict[str, Path]] = {}
    for name in names:
        last = (_parts(name) or ("",))[-1]
        stem, suffix = name_key(last), ""
        if PurePosixPath(last).suffix.lower() in IMAGE_SUFFIXES:
            stem, suffix = name_key(PurePosixPath(last).stem), PurePosixPath(last).suffix.lower()
        for path in index.get(stem, ()):
            folder = path.parent
            if path in taken or _BESIDE_IMAGES & {part.lower() for part in folder.relative_to(source.root).parts}:
                continue
            images = by_folder.setdefault(folder, {})
            if name not in images or path.suffix.lower() == suffix:
                images[name] = path

    def rank(folder: Path) -> tuple[int, int, int]:
        inside = folder.relative_to(source.root).parts
        common = 0
        while common < min(len(inside), len(parts)) and inside[-1 - common] == parts[-1 - common]:
            common += 1
        usual = -USUAL_FOLDERS.index(folder.name) if folder.name in USUAL_FOLDERS else -len(USUAL_FOLDERS)
        return len(by_folder[folder]), common, usual if bare else 0

    ranked = sorted(by_folder, key=rank, reverse=True)
    if not ranked or (len(ranked) > 1 and rank(ranked[0]) == rank(ranked[1])):
        return {}
    return {name: source.check_inside(path) for name, path in by_folder[ranked[0]].items()}


def located(source: Source, frames: Sequence[F]) -> Listing[F]:
    """The frames with their images, in the order of the frames. Raises BadInput for an image outside of the source."""
    listing: Listing[F] = Listing()
    results = [source.find(frame.name, frame.beside) for frame in frames]
    taken = {result.path for result in results if result.path is not None}
    present = [frame.name for frame, result in zip(frames, results, strict=True) if result.path is not None]
    missing = [frame.name for frame, result in zip(frames, results, strict=True) if result.path is None]
    elsewhere = relocated(source, missing, present, taken, all(frame.bare for frame in frames)) if missing else {}
    seen: set[Path] = set()
    for frame, result in zip(frames, results, strict=True):
        path = result.path or elsewhere.get(frame.name)
        name = printable(frame.name, MAX_NAME)
        if path is None:
            listing.missing.append(name)
            continue
        if path in seen:
            listing.repeated.append((name, f"the same image as an earlier frame ({source.name_of(path)})"))
            continue
        seen.add(path)
        listing.found.append((frame, path))
        how = result.how if result.path is not None else "elsewhere"
        if not frame.bare and how == "elsewhere":
            listing.places.append((name, source.name_of(path)))
        elif not frame.bare and how == "extension":
            listing.extensions.append((name, source.name_of(path)))
    return listing


def files_of(source: Source, frames: Sequence[Frame]) -> list[Path]:
    """The images of the frames and their masks."""
    listing = located(source, frames)
    beside = masks_of(source, [path for frame, path in listing.found if frame.mask is None])
    masks = [frame.mask for frame, _ in listing.found if frame.mask is not None]
    return [*(path for _, path in listing.found), *masks, *beside.values()]


def capture_of(
    source: Source,
    frames: Sequence[Frame],
    settings: ImportSettings,
    *,
    kind: str,
    where: str,
    rejected: Sequence[tuple[str, str]] = (),
    warnings: Sequence[str] = (),
    points: Callable[[dict[str, int]], SparsePoints | None] | None = None,
    **more: Any,
) -> Capture:
    """The capture of the frames.

    rejected  (name, reason) of images that the source names without a camera, e.g. not aligned
    points    from the place of each photo by its listed name
    more      further fields of Capture
    Raises BadInput where too few images remain.
    """
    check_count(len(frames), where)
    listing = located(source, frames)
    photos, names, unreadable, remarks = _photos(source, listing)
    said = [*warnings, *missing_images_warning(where, len(frames), len(photos), listing.missing, settings.strict, REMEDY)]
    if len(photos) < MIN_IMAGES:
        raise BadInput(f"{where}: {len(photos)} usable images of {len(frames)} cameras; at least {MIN_IMAGES} are needed.")
    said += moved_images_warnings(where, listing.places, listing.extensions) + lenses.fit_warnings(where, remarks)
    said += [f"{name}: {why}; left out." for name, why, _ in unreadable]
    if rejected:
        reasons = Counter(why for _, why in rejected).most_common()
        said += [f"{where}: {count} images are left out, {why}: {abbreviated([name for name, one in rejected if one == why])}." for why, count in reasons]
    if listing.repeated:
        said.append(f"{where}: {len(listing.repeated)} cameras name an image that an earlier one has, e.g. {listing.repeated[0][0]}; they were left out.")
    order = sorted(range(len(photos)), key=lambda index: (SPLIT_ORDER[photos[index].split], photos[index].camera.name))
    return Capture(
        kind=kind,
        photos=tuple(photos[index] for index in order),
        background=None,
        points=points({names[index]: place for place, index in enumerate(order)}) if points is not None else None,
        rejected=(
            *((name, "listed but missing on disk") for name in listing.missing),
            *listing.repeated,
            *((name, why) for name, why, _ in unreadable),
            *rejected,
        ),
        warnings=tuple(said),
        rejected_files={name: path for name, _, path in unreadable},
        **more,
    )


def _photos(source: Source, listing: Listing[Frame]) -> tuple[list[Photo], list[str], list[tuple[str, str, Path]], dict[str, list[str]]]:
    """Photos, their listed names, the unreadable as (name, reason, file), and what `lenses.fit_to_images` remarks."""
    photos: list[Photo] = []
    names: list[str] = []
    unreadable: list[tuple[str, str, Path]] = []
    remarks: dict[str, list[str]] = {}
    beside = masks_of(source, [path for frame, path in listing.found if frame.mask is None])
    readable: list[tuple[Frame, Path]] = []
    stated: list[tuple[Camera, Header, str]] = []
    for frame, path in listing.found:
        name = source.name_of(path)
        try:
            header = read_header(source.real(path))
        except UnreadableImage as error:
            unreadable.append((name, str(error), source.real(path)))
            continue
        stated.append((lenses.validated(frame.camera(name, header.size), frame.where), header, frame.where))
        readable.append((frame, path))
    for (frame, path), (camera, remark) in zip(readable, lenses.fit_to_images(stated), strict=True):
        if remark is not None:
            remarks.setdefault(remark, []).append(camera.name)
        mask = frame.mask or beside.get(path)
        photos.append(Photo(camera, source.real(path), None if mask is None else source.real(mask), split=frame.split))
        names.append(frame.name)
    return photos, names, unreadable, remarks


def sparse_points(xyz: np.ndarray, rgb: np.ndarray | None, tracks: Sequence[tuple[int, ...]] | None = None) -> SparsePoints | None:
    """Points of unknown error; None: there are none."""
    if not len(xyz):
        return None
    colours = np.full((len(xyz), 3), 128, np.uint8) if rgb is None else np.clip(np.rint(rgb), 0, 255).astype(np.uint8)
    return SparsePoints(xyz, colours, np.full(len(xyz), np.nan), tuple(tracks) if tracks is not None else ((),) * len(xyz))
