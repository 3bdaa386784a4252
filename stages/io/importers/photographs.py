"""Folders of photographs or videos: which files are photographs, the masks beside them, and which are videos.

Videos count where there are no photographs: a phone keeps a short clip beside each of its own.

A mask lies in a folder `masks` beside or inside that of the images, or at the top of the source, at the image's own relative path. That of IMG_1.jpg is called
IMG_1.png (nerfstudio), IMG_1.jpg.png (COLMAP), IMG_1.mask.png or IMG_1.jpg.mask (Brush), or IMG_1_mask.png; where it is black, the image is left out.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from pipeline.errors import BadInput
from stages.io.importers.source import IMAGE_SUFFIXES, MAX_FRAMES, MIN_IMAGES, ImportSettings, Source, images_in, one_of_each
from stages.video.reading import KNOWN, SUFFIXES

MASKS = "masks"
# What conversions leave beside the photographs: reductions, depth maps, masks.
NOT_PHOTOGRAPHS = {MASKS, "mask", "depth", "depths", "sparse", "dense", "stereo"}


def recognises(folder: Path, allow_outside: bool = False) -> bool:
    return bool(images_in(folder) or images_in(folder / "images") or _videos_in(folder))


def is_video(path: Path) -> bool:
    """Whether a file has the name of a video."""
    return path.suffix.lower() in SUFFIXES


def _videos_in(folder: Path) -> list[Path]:
    if not os.path.isdir(folder):
        return []
    return sorted(path for path in folder.iterdir() if is_video(path) and not path.name.startswith(".") and path.is_file())


def photographs(source: Source) -> list[Path]:
    """The photographs of a source: directly in it, else in its folder images/, else anywhere below it; sorted by path. Where there are none, its videos.

    Raises BadInput.
    """
    folder = source.root
    found = images_in(folder) or images_in(folder / "images") or _videos_in(folder)
    if not found:
        everything = source.walk()
        usable = [path for path in everything if not NOT_PHOTOGRAPHS & set(path.relative_to(folder).parts[:-1])]
        found = one_of_each(sorted(path for path in usable if path.suffix.lower() in IMAGE_SUFFIXES)) or sorted(filter(is_video, usable))
        if not found:
            raise BadInput(_nothing(folder, everything))
    if len(found) > MAX_FRAMES:
        raise BadInput(f"{folder}: {len(found)} images; at most {MAX_FRAMES} are read.")
    return [source.check_inside(path) for path in found]


def masks_of(source: Source, images: Sequence[Path]) -> dict[Path, Path]:
    """Image -> mask, of those that have one."""
    listings: dict[Path, dict[str, Path]] = {}
    found = {}
    for image in images:
        inside = image.parent.relative_to(source.root) if image.parent.is_relative_to(source.root) else Path()
        # images/a/1.jpg: images/a/masks, images/masks/a, masks/images/a, masks/a
        places = [image.parent / MASKS, source.root / MASKS / inside]
        for depth in range(len(inside.parts)):
            above, below = Path(*inside.parts[:depth]), inside.parts[depth:]
            places += [source.root / above / MASKS / Path(*below), source.root / above / MASKS / Path(*below[1:])]
            places.append(source.root / above / below[0] / MASKS / Path(*below[1:]))
        for place in dict.fromkeys(places):
            if place not in listings:
                by_stem: dict[str, Path] = {}
                for path in [*images_in(place), *_with_mask_as_suffix(place)]:
                    by_stem.setdefault(path.stem.lower(), path)
                listings[place] = by_stem
            stem = image.stem.lower()
            mask = next((listings[place][name] for name in (image.name.lower(), stem, f"{stem}.mask", f"{stem}_mask") if name in listings[place]), None)
            if mask is not None:
                found[image] = source.check_inside(mask)
                break
    return found


def _with_mask_as_suffix(folder: Path) -> list[Path]:
    """Pictures that are called IMG_1.mask, whatever format they have."""
    if not os.path.isdir(folder):
        return []
    return sorted(path for path in folder.iterdir() if path.suffix.lower() == ".mask" and not path.name.startswith(".") and path.is_file())


def files(folder: Path, settings: ImportSettings) -> list[Path]:
    """The photographs and their masks, or the videos."""
    if not folder.is_dir():
        return [folder]
    source = Source(folder, settings.allow_outside)
    images = photographs(source)
    return [*images, *masks_of(source, images).values()]


def _nothing(folder: Path, everything: Sequence[Path]) -> str:
    known = f"png, jpg, webp, tif, bmp, heic, avif or camera raw; {KNOWN}"
    if not everything:
        return f"{folder}: the folder is empty. Expected at least {MIN_IMAGES} photographs or a video ({known}), or a posed data set."
    common = Counter(path.suffix.lower() or "(no extension)" for path in everything).most_common(3)
    return (
        f"{folder}: no images of a known type, and no videos ({known}); found {', '.join(f'{count} {suffix}' for suffix, count in common)}. "
        "Convert the photographs to JPEG or PNG, or name another folder."
    )
