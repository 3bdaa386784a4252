"""Reading photographs: after EXIF rotation, 8 bits sRGB, at a working size."""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL.ExifTags import IFD, Base

from stages.io.pictures import LOSSY, UnreadableImage, exif_of, grey_of, opened, orientation_of, rgb_and_alpha

FULL_FRAME_DIAGONAL = float(np.hypot(36.0, 24.0))  # mm; the "35 mm equivalent" focal length refers to it

_APPLE, _ACCELERATION = b"Apple iOS\0", (8, 10, 3)  # beginning of Apple's maker note; of its entry: tag, signed rationals, three of them
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_SENSOR_TURNED = {1: np.eye(2), 3: -np.eye(2), 6: np.array([[0, -1], [1, 0]]), 8: np.array([[0, 1], [-1, 0]])}  # EXIF's number -> the picture's axes
_FISHEYE = ("fisheye", "fish-eye", "fish eye")  # in names of lenses; rectilinear ones of the same focal lengths do not have it


@dataclass(frozen=True)
class PhotoDetails:
    """What is known of a photograph besides its pixels."""

    # width, height: of the source after EXIF rotation, pixels
    width: int
    height: int
    # work_width, work_height: at working size
    work_width: int
    work_height: int
    orientation: int  # EXIF's number, 1 where there is none
    focal: float | None  # pixels of the source, from EXIF, or None
    maker: str  # make and model
    fisheye: bool  # whether EXIF names a fisheye lens


@dataclass(frozen=True)
class DecodedPhoto(PhotoDetails):
    """A photograph after EXIF rotation."""

    rgb: np.ndarray  # (h, w, 3) uint8 sRGB at working size
    opaque: np.ndarray | None  # (h, w) bool, False where the file's alpha is below one half; None without transparent pixels


def working_size(width: int, height: int, max_side: int) -> tuple[int, int]:
    """The size with longest side at most `max_side` that keeps the aspect best, so that one scale serves both axes.

    Sizes down to 2 % below `max_side` are tried: rounding the shorter side alone changes the aspect by up to 0.1 %.
    """
    longest = max(width, height)
    if longest <= max_side:
        return width, height
    sides = np.arange(max_side, max(1, int(max_side * 0.98)) - 1, -1)
    w, h = np.maximum(1, np.rint(width * sides / longest)), np.maximum(1, np.rint(height * sides / longest))
    best = int(np.argmin(np.round(np.abs(w / h * height / width - 1), 9)))  # the first of equals: the largest
    return int(w[best]), int(h[best])


def read_photo(path: Path, max_side: int) -> DecodedPhoto:
    """Decode a photograph; raises UnreadableImage."""
    with opened(path) as image:
        exif = exif_of(image)
        details = dict(exif.get_ifd(IFD.Exif))
        maker = " ".join(str(exif.get(tag, "")).strip(" \0") for tag in (Base.Make, Base.Model)).strip()
        orientation = orientation_of(image)
        full = image.size
        # As the sensor has it, which the numbers of EXIF refer to: libheif has turned the pixels already.
        taken = full[::-1] if image.info.get("original_orientation") in range(5, 9) else full
        # Let the JPEG decoder downscale by a power of two where that is exact and still above the working size.
        if image.format == "JPEG" and image.mode in ("RGB", "L"):
            scale = 1
            while scale < 8 and max(image.size) >= 2 * scale * max_side and all(side % (2 * scale) == 0 for side in image.size):
                scale *= 2
            if scale > 1:
                image.draft(image.mode, (image.size[0] // scale, image.size[1] // scale))
        rgb, alpha = rgb_and_alpha(image)
    width, height = full if orientation < 5 else full[::-1]
    rgb = resized(apply_exif_orientation(rgb, orientation), working_size(width, height, max_side))
    opaque = None
    if alpha is not None and (alpha < 128).any():
        opaque = resized(apply_exif_orientation(alpha, orientation), (rgb.shape[1], rgb.shape[0])) >= 128
    size = width, height, rgb.shape[1], rgb.shape[0]
    fisheye = any(word in str(details.get(Base.LensModel, "")).lower() for word in _FISHEYE)
    return DecodedPhoto(*size, orientation, focal_from_exif(details, *taken), maker, fisheye, rgb, opaque)


def read_mask_file(path: Path, photo: PhotoDetails) -> np.ndarray:
    """(h, w) bool at the photograph's working size, True where the mask is not black; raises UnreadableImage."""
    levels, lossy = read_levels(path, photo.orientation, photo.width, photo.height)
    if not same_aspect(levels.shape, (photo.height, photo.width)):
        raise UnreadableImage(f"{path.name} is {levels.shape[1]}x{levels.shape[0]}, the photograph {photo.width}x{photo.height}")
    return marked_at(levels, lossy, (photo.work_width, photo.work_height))


def read_levels(path: Path, orientation: int, width: int, height: int) -> tuple[np.ndarray, bool]:
    """A mask file of an image as that is meant to be seen, (H, W) uint8, and whether its format keeps levels only about as they were; raises UnreadableImage.

    orientation, width, height  of the image, see `upright_mask`
    """
    with opened(path) as image:
        own, lossy, levels = orientation_of(image), image.format in LOSSY, grey_of(image)
    return upright_mask(apply_exif_orientation(levels, own), orientation, width, height), lossy


def marked_at(levels: np.ndarray, lossy: bool, size: tuple[int, int]) -> np.ndarray:
    """Where a mask is not black, (h, w) bool at a working size (width, height); what a lossy format makes of black is up to 127."""
    rows, columns = (((np.arange(side) + 0.5) * own / side).astype(int) for side, own in zip(size[::-1], levels.shape, strict=True))
    return np.asarray(levels[rows][:, columns]) > (127 if lossy else 0)


def upright_mask(mask: np.ndarray, orientation: int, width: int, height: int) -> np.ndarray:
    """The mask (H, W) of an image as the image is meant to be seen.

    orientation    of the image, which a mask of its pixels as stored is turned by; a mask that has the aspect of the upright image is taken for upright
    width, height  of the image after EXIF rotation, pixels
    """
    turned = orientation >= 5 and not same_aspect(mask.shape, (height, width))
    return apply_exif_orientation(mask, orientation) if turned else mask


def same_aspect(size: tuple[int, ...], other: tuple[int, ...]) -> bool:
    """Whether two sizes (both (width, height), or both (height, width)) have the same aspect: within 1 %, or within the rounding of a side by one pixel."""
    (w, h), (width, height) = size, other
    if min(w, h, width, height) <= 0:
        return False
    return abs(width * h / (w * height) - 1) <= 0.01 or abs(height - h * width / w) <= 1 or abs(width - w * height / h) <= 1


def focal_from_exif(details: Any, width: int, height: int) -> float | None:
    """Focal length in pixels of an image of this size, or None.

    The 35 mm equivalent is defined by the diagonal of the frame (CIPA DCG-001); else the focal length in millimetres with the pixel
    density of the sensor, which is that of the image as taken (PixelXDimension), not as scaled since.
    """
    equivalent, focal = _number(details.get(Base.FocalLengthIn35mmFilm)), _number(details.get(Base.FocalLength))
    if equivalent:
        return equivalent / FULL_FRAME_DIAGONAL * float(np.hypot(width, height))
    density, unit = _number(details.get(Base.FocalPlaneXResolution)), _UNIT_MM.get(details.get(Base.FocalPlaneResolutionUnit, 2))
    if focal and density and unit:
        taken = _number(details.get(Base.ExifImageWidth)) or width
        pixels = focal * density / unit * width / taken
        return pixels if 0.2 < pixels / max(width, height) < 20 else None  # many writers state a wrong density
    return None


def read_gps_position(path: Path) -> tuple[float, float, float] | None:
    """(latitude, longitude) in degrees and altitude in metres of a picture's EXIF data; None without any of them. Raises UnreadableImage."""
    with opened(path) as image:
        tags = dict(exif_of(image).get_ifd(IFD.GPSInfo))
    latitude, longitude = _degrees(tags.get(2), tags.get(1), "NS", 90.0), _degrees(tags.get(4), tags.get(3), "EW", 180.0)
    try:
        altitude = float(tags[6]) * (-1.0 if tags.get(5) in (1, b"\x01") else 1.0)
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    known = latitude is not None and longitude is not None and np.isfinite(altitude) and abs(altitude) < 100_000.0
    return (latitude, longitude, altitude) if known else None  # type: ignore[return-value]


def read_gravity(path: Path) -> np.ndarray | None:
    """(3,) unit vector down, by the accelerometer as Apple's maker note has it, x right, y down, z forward after EXIF rotation; None without. Raises
    UnreadableImage."""
    with opened(path) as image:
        exif = exif_of(image)
        note = exif.get_ifd(IFD.Exif).get(Base.MakerNote)
        turned = image.info.get("original_orientation", exif.get(Base.Orientation, 1))  # libheif turns the pixels itself
    if not isinstance(note, bytes) or not note.startswith(_APPLE) or turned not in _SENSOR_TURNED:
        return None
    try:
        (count,) = struct.unpack_from(">H", note, 14)
        for entry in range(min(count, 200)):
            *what, at = struct.unpack_from(">HHII", note, 16 + 12 * entry)
            if tuple(what) == _ACCELERATION:
                above, below = np.array(struct.unpack_from(">6i", note, at), np.float64).reshape(3, 2).T
                right, up, towards = above / np.where(below == 0, np.nan, below)  # of the phone held upright, in g
                x, y = _SENSOR_TURNED[turned] @ (-up, -right)
                force = np.array([x, y, -towards])
                length = np.linalg.norm(force)
                return force / length if 0.8 < length < 1.2 else None  # else the phone was shaken
    except struct.error:
        pass
    return None


def _degrees(value: Any, side: Any, sides: str, most: float) -> float | None:
    """Of degrees, minutes and seconds on one of two sides."""
    try:
        whole = sum(float(part) / 60**power for power, part in enumerate(tuple(value)[:3]))
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    which = str(side).strip(" \0").upper()
    if which not in tuple(sides) or not 0 <= whole <= most:
        return None
    return whole if which == sides[0] else -whole


def _number(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if np.isfinite(number) and number > 0 else None


def apply_exif_orientation(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """The pixels (H, W, ...) as they are meant to be seen, from those stored with an EXIF orientation 1-8 (tag 274)."""
    if orientation >= 5:
        pixels = pixels.swapaxes(0, 1)
    flip_rows, flip_columns = orientation in (3, 4, 7, 8), orientation in (2, 3, 6, 7)
    return pixels[:: -1 if flip_rows else 1, :: -1 if flip_columns else 1]


def resized(pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """By area averaging; contiguous."""
    pixels = np.ascontiguousarray(pixels)
    if pixels.shape[1::-1] == size:
        return pixels
    import cv2  # importers list a source's files at the door

    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA))
