"""The images that later stages read: after EXIF rotation, 8 bits sRGB, at working size, with masks."""

import re
import shutil
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import cv2
import numpy as np

from efficientnerf.geometry.cameras import Camera
from pipeline.errors import BadInput
from pipeline.text import printable
from stages.artifacts import PosesOutputs
from stages.io.capture import Photo, Silhouettes
from stages.io.matting import without_background
from stages.io.photo import apply_exif_orientation, marked_at, read_levels, resized, same_aspect, working_size
from stages.io.pictures import UnreadableImage, holds_eight_bits, opened, orientation_of, profile_of, rgb_and_alpha
from stages.io.png import FAST, write_png

MAX_PART = 200  # bytes of a part of the path of a working image
OPAQUE = 128  # alpha from which a pixel counts where alpha is used as a mask
TRANSPARENT = 8  # alpha and levels of masks up to which a pixel of a silhouette is background: what networks and filters leave of nothing
LOSSY_NOISE = 16  # the same, in formats that keep pixels only about as they were
NO_SILHOUETTES = Silhouettes()


@dataclass(frozen=True, eq=False)
class Decoded:
    """A source image after EXIF rotation."""

    pixels: np.ndarray  # (H, W, 3 or 4) uint8 sRGB, straight alpha
    verbatim: bool  # whether the file itself holds exactly these pixels in a form that later stages read
    orientation: int  # EXIF's number, 1-8
    fault: str | None = None  # why the file's colour profile is not used, if it has one and it is not


@dataclass(frozen=True)
class Written:
    """What was written for one photo: paths relative to the folder of the scene, size in pixels, warnings."""

    image: str
    mask: str | None
    width: int
    height: int
    warnings: tuple[str, ...] = ()


def decode(path: Path, as_stored: bool = False) -> Decoded:
    """Every pixel of an image file; raises UnreadableImage, also where the file ends early."""
    with opened(path) as image:
        orientation, profile = orientation_of(image), profile_of(image)
        # Later stages read the file itself of JPEG in colour, and of PNG with 8 bits a channel.
        plain = image.mode == "RGB" if image.format == "JPEG" else image.format == "PNG" and image.mode in ("RGB", "RGBA") and holds_eight_bits(image)
        verbatim = orientation == 1 and "transparency" not in image.info and plain and profile.transform is None
        rgb, alpha = rgb_and_alpha(image, as_stored)
    pixels = rgb if alpha is None else np.dstack([rgb, alpha])
    return Decoded(np.ascontiguousarray(apply_exif_orientation(pixels, orientation)), verbatim, orientation, profile.fault)


def write(photo: Photo, folder: Path, relative: str, *, max_side: int, silhouettes: Silhouettes = NO_SILHOUETTES, may_be_empty: bool = True) -> Written:
    """Write the working image of a photo, and its mask if it has one.

    relative      path of the image below folder/images, with its source's extension
    silhouettes   what becomes the alpha channel of the working image: the photo's own, the levels of its mask, or where both are silhouettes the lower of
                  the two. Else pixels with alpha below one half, and those that the mask leaves out, go into the mask of the working image
    may_be_empty  whether a silhouette may leave nothing

    A file that need not change is copied byte for byte, anything else becomes a PNG. Raises UnreadableImage; BadInput for a mask of another
    aspect than its image.
    """
    found = decode(photo.image)
    height, width = found.pixels.shape[:2]
    if (width, height) != (photo.camera.width, photo.camera.height):
        raise UnreadableImage(f"unreadable: {width}x{height} pixels, but {photo.camera.width}x{photo.camera.height} by its header, or it was changed")
    size = working_size(width, height, max_side)
    usable: np.ndarray | None = None
    warnings = [] if found.fault is None else [f"{photo.camera.name}: its colour profile is {found.fault}; the picture is read as sRGB."]
    whole = found.pixels
    if whole.shape[2] == 4 and not silhouettes.alpha:
        reduced = _resized(whole, size)
        whole, usable = reduced[..., :3], reduced[..., 3] >= OPAQUE
    if photo.mask is not None and silhouettes.masks:
        levels, remarks = mask_levels(photo, found.orientation)
        warnings += remarks
        whole = _cut_out(whole, levels, size)
    elif photo.mask is not None:
        levels, lossy, remarks = _read_mask(photo, found.orientation)
        warnings += remarks
        kept = marked_at(levels, lossy, size) == (photo.mask_ignore == "black")
        usable = kept if usable is None else usable & kept
    if silhouettes and not may_be_empty and whole.shape[2] == 4 and (whole[..., 3] <= TRANSPARENT).all():
        raise UnreadableImage("has an empty silhouette")
    pixels = _resized(whole, size)
    verbatim = found.verbatim and pixels is found.pixels
    path = PosesOutputs(folder).images / relative
    path = path if verbatim else path.with_name(path.stem + ".png")
    path.parent.mkdir(parents=True, exist_ok=True)
    if verbatim:
        shutil.copyfile(photo.image, path)
    else:
        write_png(pixels, path, compress_level=FAST, durable=False)
    mask = None
    if usable is not None and not usable.all():
        mask = PosesOutputs(folder).masks / PurePosixPath(relative).with_suffix(".png")
        mask.parent.mkdir(parents=True, exist_ok=True)
        write_png(np.where(usable, np.uint8(255), np.uint8(0)), mask, compress_level=FAST, durable=False)
        if not usable.any():
            warnings.append(f"{photo.camera.name}: its mask leaves out every pixel.")
    return Written(path.relative_to(folder).as_posix(), None if mask is None else mask.relative_to(folder).as_posix(), *size, tuple(warnings))


def image_paths(cameras: list[Camera]) -> list[str]:
    """A path below images/ for each camera by its name, unique even without the extension."""
    taken: set[str] = set()
    paths = []
    for camera in cameras:
        parts = [_short(part) for part in PurePosixPath(camera.name).parts if part not in ("/", "..")]
        parts = parts[1:] if len(parts) > 1 and re.fullmatch(r"images(_\d+)?", parts[0]) else parts
        path, again = PurePosixPath(*parts), 2
        while path.with_suffix("").as_posix().lower() in taken:
            path, again = PurePosixPath(*parts).with_stem(f"{PurePosixPath(*parts).stem}_{again}"), again + 1
        taken.add(path.with_suffix("").as_posix().lower())
        paths.append(path.as_posix())
    return paths


def _short(part: str) -> str:
    """A part of a path that leaves space for what is added to it, within what file systems take: 255 bytes, and a name's escapes make it longer."""
    if len(part.encode()) <= MAX_PART:
        return part
    suffix = PurePosixPath(part).suffix
    suffix = suffix if len(suffix) <= 8 else ""
    return part.encode()[: MAX_PART - 8].decode(errors="ignore") + suffix


def _resized(pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resized by area averaging in sRGB, colours weighted by alpha."""
    if pixels.shape[1::-1] == size or pixels.shape[2] == 3:
        return resized(pixels, size)
    whole = pixels.astype(np.float32)
    whole[..., :3] *= whole[..., 3:] / 255
    whole = cv2.resize(whole, size, interpolation=cv2.INTER_AREA)
    whole[..., :3] *= 255 / np.maximum(whole[..., 3:], 1e-3)
    return np.clip(np.rint(whole), 0, 255).astype(np.uint8)


def _cut_out(pixels: np.ndarray, levels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(h, w, 4) at working size: the levels of a mask of any size as alpha, or the lower of these and the alpha that is there.

    A photograph without alpha has its surroundings yet, which the colours of soft edges are freed of.
    """
    def to(size: tuple[int, int]) -> np.ndarray:
        if levels.shape[::-1] == size:
            return levels
        return np.asarray(cv2.resize(levels, size, interpolation=cv2.INTER_AREA if levels.shape[1] >= size[0] else cv2.INTER_LINEAR))

    if pixels.shape[2] == 4:
        return _resized(np.dstack([pixels[..., :3], np.minimum(to(pixels.shape[1::-1]), pixels[..., 3])]), size)
    colour, cover = _resized(np.ascontiguousarray(pixels), size), to(size)
    return np.dstack([np.where(cover[..., None] > 0, without_background(colour, cover), np.uint8(0)), cover])


def mask_levels(photo: Photo, orientation: int) -> tuple[np.ndarray, list[str]]:
    """(H, W) uint8, upright, at the mask file's size: how much of each pixel a silhouette covers; and warnings.

    A mask of two levels, as of labels, covers all where it is not black, and so does a mask that is nowhere bright; others are soft. Levels nearly black or
    nearly white are noise of a network or of a lossy format.
    """
    levels, lossy, warnings = _read_mask(photo, orientation)
    if not lossy and (levels.max(initial=0) < OPAQUE or len(np.flatnonzero(np.bincount(levels.ravel(), minlength=256))) <= 2):
        levels = np.where(levels > 0, np.uint8(255), np.uint8(0))
    else:
        noise = LOSSY_NOISE if lossy else TRANSPARENT
        levels = np.where(levels <= noise, np.uint8(0), np.where(levels >= 255 - noise, np.uint8(255), levels))
    return levels if photo.mask_ignore == "black" else 255 - levels, warnings


def _read_mask(photo: Photo, orientation: int) -> tuple[np.ndarray, bool, list[str]]:
    """The photo's mask file as `read_levels` has it, and warnings. Raises UnreadableImage, BadInput."""
    assert photo.mask is not None
    expected = photo.camera.width, photo.camera.height
    try:
        levels, lossy = read_levels(photo.mask, orientation, *expected)
    except UnreadableImage as error:
        raise UnreadableImage(f"its mask {printable(photo.mask.name)} is {error}") from error
    found = levels.shape[1], levels.shape[0]
    sizes = f"the mask is {found[0]}x{found[1]}, its image {expected[0]}x{expected[1]}"
    if not same_aspect(found, expected):
        raise BadInput(f"{printable(photo.mask)}: {sizes}, of another aspect. Make the mask for this image.")
    return levels, lossy, [] if found == expected else [f"{printable(photo.mask.name)}: {sizes}; it was resized."]
