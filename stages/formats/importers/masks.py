"""Masks next to photographs.

A mask lies in a folder `masks` (or `mask`, in any case) next to or inside that of the images, or at the top of the source, at the image's relative path.
That of IMG_1.jpg is called IMG_1.png (nerfstudio), IMG_1.jpg.png (COLMAP), IMG_1.mask.png or IMG_1.jpg.mask (Brush), or IMG_1_mask.png; by the latter names it
may lie in the folder of the photograph itself. Where it is black, the image is left out.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path

from stages.formats.importers.source import MASK_ENDINGS, Source, files_in, images_in, name_key, pictures_in

FOLDERS = ("masks", "mask")
_SUFFIX = (".mask",)  # IMG_1.mask, whatever format it has


def masks_of(source: Source, images: Sequence[Path]) -> dict[Path, Path]:
    """Image -> mask, of those that have one."""
    masks_in, files_inside, files_adjacent = cache(_masks_in), cache(_files_inside), cache(_files_adjacent)  # each folder is read once
    photographs = set(images)
    found = {}
    for image in images:
        stem, name = name_key(image.stem), name_key(image.name)
        endings = [f"{each}{ending}" for each in (stem, name) for ending in reversed(MASK_ENDINGS)]
        listings = [(files_inside(place), [name, stem, *endings]) for place in dict.fromkeys(_places(source, image, masks_in))]
        listings.append((files_adjacent(image.parent), endings))
        candidates = (listing[key] for listing, keys in listings for key in keys if key in listing)
        mask = next((path for path in candidates if path not in photographs), None)
        if mask is not None:
            found[image] = source.check_inside(mask)
    return found


def _places(source: Source, image: Path, masks_in: Callable[[Path], list[Path]]) -> Iterator[Path]:
    """Where the mask of an image may lie, in order: of images/a/1.jpg in images/a/masks, masks/images/a, images/masks/a, masks/a."""
    root = source.root
    inside = image.parent.relative_to(root) if image.parent.is_relative_to(root) else Path()
    yield from masks_in(image.parent)
    yield from (masks / inside for masks in masks_in(root))
    for depth in range(len(inside.parts)):
        above, below = root.joinpath(*inside.parts[:depth]), inside.parts[depth:]
        for masks in masks_in(above):
            yield masks.joinpath(*below)
            yield masks.joinpath(*below[1:])
        yield from (masks.joinpath(*below[1:]) for masks in masks_in(above / below[0]))


def _masks_in(folder: Path) -> list[Path]:
    """The folders of masks that lie in a folder."""
    names = sorted(os.listdir(folder)) if os.path.isdir(folder) else []
    found = sorted((FOLDERS.index(name_key(name)), name) for name in names if name_key(name) in FOLDERS)
    return [folder / name for _, name in found if os.path.isdir(folder / name)]


def _files_inside(folder: Path) -> dict[str, Path]:
    """The masks in a folder of masks by the key of their stem."""
    return {name_key(path.stem): path for path in reversed([*images_in(folder), *files_in(folder, _SUFFIX)])}


def _files_adjacent(folder: Path) -> dict[str, Path]:
    """The masks in a folder of photographs by the key of their name without what follows the ending."""
    named = {name_key(path.stem): path for path in reversed(pictures_in(folder)) if name_key(path.stem).endswith(MASK_ENDINGS)}
    return named | {name_key(path.name): path for path in files_in(folder, _SUFFIX)}
