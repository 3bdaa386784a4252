"""Folders of photographs or videos: which files are photographs, and which are videos.

Photographs come first: a phone keeps a short clip with each of its own. Videos count where there are fewer photographs than make a data set.

One picture that lies there twice (IMG_1.HEIC and IMG_1.JPG, as clouds export them) is read once: of two photographs of one name in a folder, which differ by
their extension, those that were taken at one time, or look alike.
"""

import re
from collections import Counter
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from PIL.ExifTags import IFD, Base

from pipeline.errors import BadInput
from stages.formats.importers.masks import FOLDERS, masks_of
from stages.formats.importers.source import (
    IMAGE_SUFFIXES,
    MAX_FRAMES,
    MIN_IMAGES,
    ImportSettings,
    Source,
    abbreviated,
    files_in,
    images_in,
    name_key,
    one_of_each,
)
from stages.io.photo import read_photo
from stages.io.pictures import RAW_SUFFIXES, UnreadableImage, exif_of, opened, read_header
from stages.video import KNOWN, SUFFIXES

# Left next to photographs by conversions, in any case: reductions, depth maps, masks.
NOT_PHOTOGRAPHS = {*FOLDERS, "depth", "depths", "sparse", "dense", "stereo", "thumbnails", "thumbs", "@eadir"}
CORRECTED = "corrected_images"
_REDUCED = re.compile(r"images_\d+")
_MAP = re.compile(r"(?:depth|conf)_(\d+)\.png")  # of a phone's sensor
_PREFERRED = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".heic", ".heif", ".hif", ".avif", ".webp", ".bmp")  # of one picture in several formats
_SMALL, _ALIKE, _ANYWHERE = 64, 4.0, 48  # px, longest side; levels of 255 that formats differ by, in the mean and anywhere


def recognises(folder: Path, allow_outside: bool = False) -> bool:
    return bool(images_in(folder) or images_in(folder / "images") or files_in(folder, SUFFIXES))


def is_video(path: Path) -> bool:
    """Whether a file has the name of a video."""
    return path.suffix.lower() in SUFFIXES


def photographs(source: Source) -> list[Path]:
    """The photographs of a source: directly in it, in its folder images/, or, where there are too few, anywhere below it; sorted by path. Where there are too
    few below, too, its videos. The source's remarks list those left aside.

    Raises BadInput.
    """
    found = _all(source)
    named: dict[tuple[Path, str], list[Path]] = {}
    for path in found:
        named.setdefault((path.parent, name_key(path.stem)), []).append(path)
    left: dict[Path, Path] = {}
    for same in named.values():
        kept: list[Path] = []
        for path in sorted(same, key=lambda path: _preference(source, path)) if len(same) > 1 else ():
            twin = next((other for other in kept if _is_same_picture(source.real(path), source.real(other))), None)
            if twin is None:
                kept.append(path)
            else:
                left[path] = twin
    if left:
        pairs = abbreviated([f"{source.name_of(path)} is {source.name_of(twin)}" for path, twin in sorted(left.items())])
        source.remarks[f"{source.root}: {len(left)} pictures lie there twice, in two formats, and are read once ({pairs})."] = None
    return [path for path in found if path not in left]


def _all(source: Source) -> list[Path]:
    """The same with pictures that are there twice."""
    folder = source.root
    found = next((some for some in map(_without_maps, (images_in(folder), images_in(folder / "images"))) if len(some) >= MIN_IMAGES), [])
    if found:
        _remark_on_others(source, found)
    else:
        everything = source.walk()
        usable = [path for path in everything if not _is_by_product(path, folder)]
        # Without those in a folder images/ that lie in corrected_images/ next to it, too, as Polycam writes them.
        images = _without_maps(one_of_each(sorted(path for path in usable if path.suffix.lower() in IMAGE_SUFFIXES)))
        corrected = {(path.parent.parent, path.name) for path in images if path.parent.name == CORRECTED}
        found = [path for path in images if path.parent.name != "images" or (path.parent.parent, path.name) not in corrected]
        videos = files_in(folder, SUFFIXES) or sorted(filter(is_video, usable))
        if not found and not videos:
            raise BadInput(_nothing(source, everything))
        few = len(found) < MIN_IMAGES
        if found and videos:
            unread, names = (found, "photographs") if few else (videos, "videos")
            source.remarks[f"{folder}: {_count(unread, names, source)} not read, for there are {'videos' if few else 'photographs'}."] = None
        found = videos if few and videos else found
    if len(found) > MAX_FRAMES:
        raise BadInput(f"{folder}: {len(found)} images; at most {MAX_FRAMES} are read.")
    return [source.check_inside(path) for path in found]


def _without_maps(images: Sequence[Path]) -> list[Path]:
    """Without depth_00000.png and conf_00000.png where frame_00000.json lies next to them, as 3D Scanner App writes them."""
    numbers = {path: found[1] for path in images if (found := _MAP.fullmatch(path.name))}
    return [path for path in images if path not in numbers or not path.with_name(f"frame_{numbers[path]}.json").is_file()]


def _count(paths: Sequence[Path], what: str, source: Source) -> str:
    return f"{len(paths)} {what if len(paths) > 1 else what[:-1]} ({abbreviated([source.name_of(path) for path in paths])}) {'are' if len(paths) > 1 else 'is'}"


def _is_by_product(path: Path, folder: Path) -> bool:
    """Whether a file lies in a folder that conversions leave next to photographs."""
    return not NOT_PHOTOGRAPHS.isdisjoint(map(name_key, path.relative_to(folder).parts[:-1]))


def _remark_on_others(source: Source, found: Sequence[Path]) -> None:
    """Say which folders hold images that are not read, for there are enough directly in the source, or in images/."""
    folder, here = source.root, found[0].parent
    try:
        everything = source.walk()
    except BadInput:  # more files than a data set has
        return
    images = (path for path in everything if path.suffix.lower() in IMAGE_SUFFIXES and path.parent != here and not _is_by_product(path, folder))
    others = one_of_each([path for path in images if not any(_REDUCED.fullmatch(part) for part in path.relative_to(folder).parts)])
    if others:
        count = f"{len(others)} more images" if len(others) > 1 else "1 more image"
        names = sorted({source.name_of(path.parent) if path.parent != folder else "." for path in others})
        source.remarks[
            f"{folder}: {count} in other folders ({abbreviated(names)}) {'are' if len(others) > 1 else 'is'} not read, for {len(found)} lie directly in "
            f"{here.name if here != folder else 'it'}. Name the folders as sources of their own, or put the photographs together."
        ] = None


def _preference(source: Source, path: Path) -> tuple[bool, int, Path]:
    """Of one picture in several formats that which kept the camera's data, then that which is decoded fastest, comes first."""
    try:
        taken = _taken(source.real(path))
    except UnreadableImage:
        taken = None
    suffix = path.suffix.lower()
    return taken is None, _PREFERRED.index(suffix) if suffix in _PREFERRED else len(_PREFERRED), path


def _is_same_picture(path: Path, other: Path) -> bool:
    suffixes = {path.suffix.lower(), other.suffix.lower()}
    if len(suffixes) < 2 or suffixes & {*RAW_SUFFIXES, *SUFFIXES}:
        return False
    return _are_alike(path, path.stat().st_mtime_ns, other, other.stat().st_mtime_ns)


@lru_cache(maxsize=MAX_FRAMES)
def _are_alike(path: Path, changed: int, other: Path, other_changed: int) -> bool:
    """Whether two files are one picture; asked again where one has changed."""
    try:
        headers, times = [read_header(each) for each in (path, other)], [_taken(each) for each in (path, other)]
        if headers[0].size != headers[1].size or headers[0].alpha != headers[1].alpha:
            return False
        if all(times):
            return times[0] == times[1]
        small = [read_photo(each, _SMALL).rgb.astype(int) for each in (path, other)]
    except UnreadableImage:
        return False
    difference = np.abs(small[0] - small[1])
    return bool(difference.mean() <= _ALIKE and difference.max() <= _ANYWHERE)


def _taken(path: Path) -> tuple[str, str] | None:
    """When a photograph was taken, by its EXIF data."""
    with opened(path) as image:
        tags = dict(exif_of(image).get_ifd(IFD.Exif))
    time = str(tags.get(Base.DateTimeOriginal, "")).strip(" \0")
    return (time, str(tags.get(Base.SubsecTimeOriginal, "")).strip(" \0")) if any(digit in time for digit in "123456789") else None


def files(folder: Path, settings: ImportSettings) -> list[Path]:
    """The photographs and their masks, or the videos; with pictures that are there twice, for what they hold decides."""
    if not folder.is_dir():
        return [folder]
    source = Source(folder, settings.allow_outside)
    images = _all(source)
    return [*images, *masks_of(source, images).values()]


def _nothing(source: Source, everything: Sequence[Path]) -> str:
    known = f"png, jpg, webp, tif, bmp, heic, avif or camera raw; {KNOWN}"
    links = f" It holds {source.linked_folders()}." if source.links else ""
    if not everything:
        what = "no files" if source.links else "the folder is empty"
        return f"{source.root}: {what}. Expected at least {MIN_IMAGES} photographs or a video ({known}), or a posed data set.{links}"
    common = Counter(path.suffix.lower() or "(no extension)" for path in everything).most_common(3)
    return (
        f"{source.root}: no images of a known type, and no videos ({known}); found {', '.join(f'{count} {suffix}' for suffix, count in common)}. "
        f"Convert the photographs to JPEG or PNG, or name another folder.{links}"
    )
