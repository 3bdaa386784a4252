"""The images that later stages read: after EXIF rotation, 8 bits sRGB, at working size, with masks."""

from __future__ import annotations

import re
import shutil
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from efficientnerf.geometry.cameras import Camera
from pipeline.errors import BadInput
from pipeline.text import printable
from stages.artifacts import PosesOutputs
from stages.io.capture import Photo
from stages.io.photo import apply_exif_orientation, same_aspect, upright_mask, working_size
from stages.io.pictures import LOSSY, UnreadableImage, holds_eight_bits, opened, orientation_of, read_header, rgb_and_alpha
from stages.io.png import FAST, write_png

MAX_PART = 200  # bytes of a part of the path of a working image
OPAQUE = 128  # alpha from which a pixel counts where alpha is used as a mask


@dataclass(frozen=True, eq=False)
class Decoded:
    """A source image after EXIF rotation.

    pixels       (H, W, 3 or 4) uint8 sRGB, straight alpha
    verbatim     whether the file itself holds exactly these pixels in a form that later stages read
    orientation  EXIF's number, 1-8
    lossy        whether the format keeps pixels only about as they were
    """

    pixels: np.ndarray
    verbatim: bool
    orientation: int
    lossy: bool


@dataclass(frozen=True)
class Written:
    """What was written for one photo: paths relative to the folder of the scene, size in pixels, warnings."""

    image: str
    mask: str | None
    width: int
    height: int
    warnings: tuple[str, ...] = ()


def decode(path: Path) -> Decoded:
    """Every pixel of an image file; raises UnreadableImage, also where the file ends early."""
    with opened(path) as image:
        orientation = orientation_of(image)
        verbatim = orientation == 1 and "transparency" not in image.info and _is_plain(image)
        lossy = image.format in LOSSY
        rgb, alpha = rgb_and_alpha(image)
    pixels = rgb if alpha is None else np.dstack([rgb, alpha])
    return Decoded(np.ascontiguousarray(apply_exif_orientation(pixels, orientation)), verbatim, orientation, lossy)


def has_transparency(path: Path) -> bool:
    """Whether any pixel of an image is not opaque; raises UnreadableImage."""
    pixels = decode(path).pixels
    return pixels.shape[2] == 4 and bool((pixels[..., 3] < 255).any())


def alpha_is_coverage(photos: tuple[Photo, ...], choice: str, may_be_renders: bool) -> bool:
    """Whether alpha is coverage (the images are composited on a constant background) instead of a mask.

    choice          the setting: "auto", "composite" or "mask"
    may_be_renders  whether the capture's format may hold renders of an object, as transforms.json may

    "auto" composites where every image of such a format holds an alpha channel and most have transparent pixels: renders of an object. Opaque
    images, also in Blender's dialect, show real or rendered surroundings, and a few images with alpha among opaque ones are masked photographs.
    Images that cannot be read have no say.
    """
    if choice != "auto":
        return choice == "composite"
    if not may_be_renders or not all(read_header(photo.image).alpha for photo in photos):
        return False
    transparent = opaque = 0
    for photo in photos:
        try:
            transparent, opaque = (transparent + 1, opaque) if has_transparency(photo.image) else (transparent, opaque + 1)
        except UnreadableImage:
            continue
        if 2 * max(transparent, opaque) > len(photos):
            break
    return transparent > opaque


def write(photo: Photo, folder: Path, relative: str, *, max_side: int, keep_alpha: bool) -> Written:
    """Write the working image of a photo, and its mask if it has one.

    relative    path of the image below folder/images, with its source's extension
    max_side    longest side of the working image, pixels
    keep_alpha  write RGBA as it is; else pixels with alpha below one half go into the mask

    A file that need not change is copied byte for byte, anything else becomes a PNG. Raises UnreadableImage; BadInput for a mask of another
    aspect than its image.
    """
    found = decode(photo.image)
    height, width = found.pixels.shape[:2]
    if (width, height) != (photo.camera.width, photo.camera.height):
        raise UnreadableImage(f"unreadable: {width}x{height} pixels, but {photo.camera.width}x{photo.camera.height} by its header, or it was changed")
    size = working_size(width, height, max_side)
    usable, warnings = (None, []) if photo.mask is None else _usable(photo, size, found.orientation)
    pixels = _resized(found.pixels, size)
    has_alpha = pixels.shape[2] == 4
    if has_alpha and not keep_alpha:
        opaque = pixels[..., 3] >= OPAQUE
        usable = opaque if usable is None else usable & opaque
        pixels = pixels[..., :3]
    verbatim = found.verbatim and size == (width, height) and (keep_alpha or not has_alpha)
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
    """A part of a path that leaves room for what is added to it, within what file systems take: 255 bytes, and a name's escapes make it longer."""
    if len(part.encode()) <= MAX_PART:
        return part
    suffix = PurePosixPath(part).suffix
    suffix = suffix if len(suffix) <= 8 else ""
    return part.encode()[: MAX_PART - 8].decode(errors="ignore") + suffix


def _is_plain(image: Any) -> bool:
    """Whether later stages read the file itself: JPEG in colour, PNG with 8 bits a channel."""
    return image.mode == "RGB" if image.format == "JPEG" else image.format == "PNG" and image.mode in ("RGB", "RGBA") and holds_eight_bits(image)


def _resized(pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resized by area averaging in sRGB, colours weighted by alpha."""
    import cv2

    if pixels.shape[1::-1] == size:
        return pixels
    if pixels.shape[2] == 3:
        return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))
    whole = pixels.astype(np.float32)
    whole[..., :3] *= whole[..., 3:] / 255
    whole = cv2.resize(whole, size, interpolation=cv2.INTER_AREA)
    whole[..., :3] *= 255 / np.maximum(whole[..., 3:], 1e-3)
    return np.clip(np.rint(whole), 0, 255).astype(np.uint8)


def _usable(photo: Photo, size: tuple[int, int], orientation: int) -> tuple[np.ndarray, list[str]]:
    """(h, w) bool at working size from the photo's mask file, and warnings."""
    assert photo.mask is not None
    try:
        decoded = decode(photo.mask)
    except UnreadableImage as error:
        raise UnreadableImage(f"its mask {printable(photo.mask.name)} is {error}") from error
    expected = photo.camera.width, photo.camera.height
    mask = upright_mask(decoded.pixels[..., :3].max(-1), orientation, *expected)  # any colour counts as not black
    found = mask.shape[1], mask.shape[0]
    sizes = f"the mask is {found[0]}x{found[1]}, its image {expected[0]}x{expected[1]}"
    if not same_aspect(found, expected):
        raise BadInput(f"{printable(photo.mask)}: {sizes}, of another aspect. Make the mask for this image.")
    warnings = [] if found == expected else [f"{printable(photo.mask.name)}: {sizes}; it was resized."]
    rows = ((np.arange(size[1]) + 0.5) * found[1] / size[1]).astype(int)
    columns = ((np.arange(size[0]) + 0.5) * found[0] / size[0]).astype(int)
    # Lossy files have no clean zero.
    marked = mask[rows][:, columns] > (127 if decoded.lossy else 0)
    return marked if photo.mask_ignore == "black" else ~marked, warnings
