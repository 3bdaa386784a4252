"""Frames, and the images that they name.

Missing images are looked for, one listed folder at a time: where nothing of a listed folder is found, the one folder of the source with most of its names
stands in for it (images/ listed, rgb/ there). A tie between two folders is not decided.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

from efficientnerf.geometry.cameras import Camera
from pipeline.errors import BadInput
from pipeline.text import printable
from stages.formats.importers.photographs import NOT_PHOTOGRAPHS
from stages.formats.importers.source import IMAGE_SUFFIXES, MAX_FRAMES, MIN_IMAGES, Source, name_key

MAX_NAME = 200  # characters of a listed name that are shown
USUAL_FOLDERS = ("images", "image", "rgb", "input", "photos", "color")  # which of several that hold a bare name is meant
_NOT_IMAGES = NOT_PHOTOGRAPHS | {"confidence"}  # folders with files of the names of images


# (name, (width, height) of the upright image) -> its camera, at the size that the file states or at that of the image
CameraOf = Callable[[str, tuple[int, int]], Camera]


@dataclass(frozen=True)
class Frame:
    """An image that a file lists."""

    name: str  # as listed, relative to `folder`
    folder: Path
    where: str  # what messages call it
    camera: CameraOf
    bare: bool = False  # the format states no folder: the name alone is looked for, and its place is not reported
    mask: Path | None = None  # where the format names masks; else one next to the image is looked for
    split: str | None = None
    # near, far: along the view axis, where the format states them
    near: float | None = None
    far: float | None = None
    own: Any = None  # what the format keeps of it for itself


def stated(camera: Camera) -> CameraOf:
    """For a frame: a camera whose size the file states."""
    return lambda name, size: replace(camera, name=name)


@dataclass
class Listing:
    """Frames with the images that they led to."""

    found: list[tuple[Frame, Path]] = field(default_factory=list)  # (frame, its image)
    missing: list[str] = field(default_factory=list)  # names, as they may be shown
    repeated: list[tuple[str, str]] = field(default_factory=list)  # (name, reason) of those that name an image again
    places: list[tuple[str, str]] = field(default_factory=list)  # (listed, found) of those found at another place


def check_count(count: int, where: str) -> None:
    """Raise BadInput for no frames, or more than are read."""
    if not count:
        raise BadInput(f"{where}: no cameras. At least {MIN_IMAGES} are needed.")
    if count > MAX_FRAMES:
        raise BadInput(f"{where}: {count} cameras; at most {MAX_FRAMES} are read.")


def relocate(source: Source, names: Sequence[str], present: Iterable[str], taken: set[Path], bare: bool = False) -> dict[str, Path]:
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
    by_folder: dict[Path, dict[str, Path]] = {}
    for name in names:
        last = (_parts(name) or ("",))[-1]
        stem, suffix = name_key(last), ""
        if PurePosixPath(last).suffix.lower() in IMAGE_SUFFIXES:
            stem, suffix = name_key(PurePosixPath(last).stem), PurePosixPath(last).suffix.lower()
        for path in source.images_by_stem.get(stem, ()):
            folder = path.parent
            if path in taken or _NOT_IMAGES & {part.lower() for part in folder.relative_to(source.root).parts}:
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


def locate(source: Source, frames: Sequence[Frame]) -> Listing:
    """The frames with their images, in the order of the frames. Raises BadInput for an image outside of the source."""
    listing = Listing()
    results = [source.find(frame.name, frame.folder) for frame in frames]
    taken = {result.path for result in results if result.path is not None}
    present = [frame.name for frame, result in zip(frames, results, strict=True) if result.path is not None]
    missing = [frame.name for frame, result in zip(frames, results, strict=True) if result.path is None]
    elsewhere = relocate(source, missing, present, taken, all(frame.bare for frame in frames)) if missing else {}
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
        if not frame.bare and (result.elsewhere or result.path is None):
            listing.places.append((name, source.name_of(path)))
    return listing
