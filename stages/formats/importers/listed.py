"""Formats that list frames: how one is recognised and read, with what all of them have in common."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from efficientnerf.geometry.cameras import Camera
from pipeline.errors import BadInput
from stages.formats.importers import lenses
from stages.formats.importers.depth import DepthFile, with_depth
from stages.formats.importers.frames import Frame, Listing, check_count, locate
from stages.formats.importers.masks import masks_of
from stages.formats.importers.source import MIN_IMAGES, ImportSettings, Source, abbreviated
from stages.io.capture import Capture, Photo, SparsePoints
from stages.io.pictures import Header, UnreadableImage, read_header

Masks = dict[Path, tuple[Path, str]]  # image -> its mask, and which of the mask's pixels are left out
Y_UP, Z_UP = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
_SPLITS = ("train", "val", "test", None)


def listed_or_adjacent(source: Source, found: Sequence[tuple[Frame, Path]]) -> Masks:
    """The masks that frames name; of those that name none, the masks next to their images."""
    stated = {image: frame.mask for frame, image in found if frame.mask is not None}
    return {image: (mask, "black") for image, mask in (stated | masks_of(source, [image for _, image in found if image not in stated])).items()}


@dataclass(frozen=True)
class Listed:
    """What a source states. The others are fields of `Capture`."""

    where: str  # what messages call it
    frames: Sequence[Frame]
    files: Sequence[Path]  # those that state it
    rejected: Sequence[tuple[str, str]] = ()  # (name, reason) of images that it names without a camera, e.g. not aligned
    warnings: Sequence[str] = ()
    up: np.ndarray | None = None
    bounds: np.ndarray | None = None
    metric: bool = False
    facts: dict[str, object] = field(default_factory=dict)
    masks: Callable[[Source, Sequence[tuple[Frame, Path]]], Masks] = listed_or_adjacent  # of frames with their images
    depth: Callable[[Frame, Path], DepthFile | None] = lambda frame, image: None  # of a frame and its image
    # adds to the capture what depends on the photos; with the frames in their order
    finish: Callable[[Capture, Sequence[Frame]], Capture] = lambda capture, frames: capture
    remedy: str = "Copy them into the source folder, or export again without them."  # for images that are missing
    expected_remarks: Sequence[str] = ()  # remarks of `lenses.fit_to_images` that are no news


@dataclass(frozen=True)
class ListFormat:
    """See `stages.formats.importers.Importer`."""

    kind: str
    expected: str  # what a folder of this format holds, for messages
    signs: Callable[[Source], Sequence[Path]]  # files that a folder of this format has
    listed: Callable[[Source, Sequence[Path]], Listed]  # what the source states; BadInput where it cannot be read
    recognised: Callable[[Source, Sequence[Path]], bool] = lambda source, signs: True  # whether they are of this format, where their being there does not tell
    single: bool = False  # whether there may be one such file alone

    def recognises(self, folder: Path, allow_outside: bool = False) -> bool:
        source = Source(folder, allow_outside)
        signs = self.signs(source)
        return bool(signs) and self.recognised(source, signs)

    def files(self, folder: Path, settings: ImportSettings) -> list[Path]:
        """What states the cameras, the images, their masks and depth maps. Raises BadInput."""
        source, stated = self._read(folder, settings)
        found = locate(source, stated.frames).found
        maps = [one for frame, image in found if (one := stated.depth(frame, image)) is not None]
        masks = [mask for mask, _ in stated.masks(source, found).values()]
        return [*stated.files, *(image for _, image in found), *masks, *(path for one in maps for path in (one.file, one.confidence) if path is not None)]

    def read(self, folder: Path, settings: ImportSettings) -> Capture:
        """The capture that the source describes. Raises BadInput, also where too few images remain."""
        source, stated = self._read(folder, settings)
        where, count = stated.where, len(stated.frames)
        check_count(count, where)
        listing = locate(source, stated.frames)
        photos, unreadable, remarks = _photos(source, stated, listing)
        warnings = [*stated.warnings, *_missing_warning(stated, listing, len(photos), settings.strict)]
        if len(photos) < MIN_IMAGES:
            raise BadInput(f"{where}: {len(photos)} usable images of {count} cameras; at least {MIN_IMAGES} are needed.")
        if listing.places:
            (name, found), *_ = listing.places
            warnings.append(f"{where}: {len(listing.places)} images are not where they are listed and were found by name, e.g. {name} as {found}.")
        warnings += lenses.fit_warnings(where, remarks)
        warnings += [f"{name}: {why}; left out." for name, why, _ in unreadable]
        for why, several in Counter(why for _, why in stated.rejected).most_common():
            names = abbreviated([name for name, one in stated.rejected if one == why])
            warnings.append(f"{where}: {several} images are left out, {why}: {names}.")
        if listing.repeated:
            again = f"{len(listing.repeated)} frames name an image that an earlier frame has, e.g. {listing.repeated[0][0]}"
            warnings.append(f"{where}: {again}; they were left out.")
        missing = [(name, "listed but missing on disk") for name in listing.missing]
        capture = Capture(
            kind=self.kind,
            photos=tuple(photo for photo, _, _ in photos),
            background=None,
            up=stated.up,
            bounds=stated.bounds,
            rejected=(*missing, *listing.repeated, *((name, why) for name, why, _ in unreadable), *stated.rejected),
            warnings=tuple(warnings),
            metric=stated.metric,
            facts=stated.facts,
            rejected_files={name: path for name, _, path in unreadable},
        )
        capture = stated.finish(capture, [frame for _, frame, _ in photos])
        return with_depth(capture, [stated.depth(frame, image) for _, frame, image in photos])

    def _read(self, folder: Path, settings: ImportSettings) -> tuple[Source, Listed]:
        source = Source(folder, settings.allow_outside, settings.llff_factor)
        signs = self.signs(source)
        if not signs:
            raise BadInput(f"{source.root}: nothing of {self.kind}: expected {self.expected}. Name the folder that holds it, or choose a format with --as.")
        if self.single and len(signs) > 1:
            names = abbreviated([source.name_of(path) for path in signs])
            raise BadInput(f"{source.root}: {len(signs)} files with cameras of {self.kind} ({names}); one is read. Take the others out.")
        return source, self.listed(source, signs)


def _photos(
    source: Source, stated: Listed, listing: Listing
) -> tuple[list[tuple[Photo, Frame, Path]], list[tuple[str, str, Path]], dict[str, list[str]]]:
    """Photos in their order with their frames and images, the unreadable as (name, reason, file), and what `lenses.fit_to_images` remarks."""
    unreadable: list[tuple[str, str, Path]] = []
    remarks: dict[str, list[str]] = {}
    readable: list[tuple[Frame, Path]] = []
    cameras: list[tuple[Camera, Header, str]] = []
    for frame, image in listing.found:
        name = source.name_of(image)
        try:
            header = read_header(source.real(image))
        except UnreadableImage as error:
            unreadable.append((name, str(error), source.real(image)))
            continue
        cameras.append((lenses.validated(frame.camera(name, header.size), frame.where), header, frame.where))
        readable.append((frame, image))
    masks, photos = stated.masks(source, listing.found), []
    for (frame, image), (camera, remark) in zip(readable, lenses.fit_to_images(cameras), strict=True):
        if remark is not None and remark not in stated.expected_remarks:
            remarks.setdefault(remark, []).append(camera.name)
        mask, ignore = masks.get(image, (None, "black"))
        photo = Photo(camera, source.real(image), None if mask is None else source.real(mask), ignore, frame.split, frame.near, frame.far)
        photos.append((photo, frame, image))
    return sorted(photos, key=lambda one: (_SPLITS.index(one[0].split), one[0].camera.name)), unreadable, remarks


def _missing_warning(stated: Listed, listing: Listing, kept: int, strict: bool) -> list[str]:
    """The warning about images that are listed but absent, if any; BadInput where too few remain or `strict` forbids it."""
    if not listing.missing:
        return []
    sentence = f"{stated.where}: {len(listing.missing)} of {len(stated.frames)} listed images are missing: {abbreviated(listing.missing)}."
    if kept < MIN_IMAGES:
        raise BadInput(f"{sentence} {kept} remain; at least {MIN_IMAGES} are needed. {stated.remedy}")
    if strict:
        raise BadInput(f"{sentence} Refused by --strict. {stated.remedy}")
    return [sentence]


def places_of(kept: Sequence[Frame]) -> dict[str, int]:
    """The place of each photo by its listed name."""
    return {frame.name: place for place, frame in enumerate(kept)}


def sparse_points(xyz: np.ndarray, rgb: np.ndarray | None, tracks: Sequence[tuple[int, ...]] | None = None) -> SparsePoints | None:
    """Points of unknown error; None: there are none."""
    if not len(xyz):
        return None
    colours = np.full((len(xyz), 3), 128, np.uint8) if rgb is None else np.clip(np.rint(rgb), 0, 255).astype(np.uint8)
    return SparsePoints(xyz, colours, np.full(len(xyz), np.nan), tuple(tracks) if tracks is not None else ((),) * len(xyz))
