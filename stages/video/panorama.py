"""360-degree pictures (equirectangular), cut into views of pinhole cameras: eight round the horizon, each of a right angle, so that neighbours share half.

The views of all pictures of one size have one lens, whose focal length is exact and stated in EXIF. Sky and ground beyond 45 degrees are left out: there a
panorama shows who carries the camera.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from PIL.ExifTags import IFD, Base

from pipeline.files import remove
from stages.io.photo import read_photo
from stages.io.pictures import MAX_SIDE, UnreadableImage, opened
from stages.io.png import FAST, write_png
from stages.scratch import note, noted, once, same_as

VIEWS = 8
_MILLIMETRE = 4  # EXIF's unit of the density of pixels


def is_panorama(path: Path) -> bool:
    """Whether a picture is twice as wide as high and says (XMP, Google's GPano) that it is equirectangular."""
    try:
        with opened(path) as image:
            width, height = image.size
            about = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or b""
    except UnreadableImage:
        return False
    text = about.encode(errors="replace") if isinstance(about, str) else bytes(about)
    return bool(width == 2 * height and b"equirectangular" in text.lower())


def view_side(width: int, max_side: int) -> int:
    """Pixels along a side of a view of a panorama so many pixels wide: as many a degree in the middle of the view."""
    return min(max_side, 2 * round(width / (2 * np.pi)))


def directions(side: int, view: int) -> np.ndarray:
    """(side, side, 3) through the pixels' centres of a view: x right and z forward in the middle of the panorama, y down."""
    along = (np.arange(side) + 0.5) / (side / 2) - 1.0
    x, y = np.meshgrid(along, along)
    angle = 2 * np.pi * view / VIEWS
    return np.stack([np.cos(angle) * x + np.sin(angle), y, np.cos(angle) - np.sin(angle) * x], axis=-1)


def cut(panorama: np.ndarray, side: int, view: int) -> np.ndarray:
    """(side, side, 3) uint8: one view of a panorama (H, 2 H, 3), its focal length half a side."""
    height, width = panorama.shape[:2]
    x, y, z = np.moveaxis(directions(side, view), -1, 0)
    # pixels' centres are at whole numbers here; a column of the other end on each side
    column = (np.arctan2(x, z) / (2 * np.pi) + 0.5) * width - 0.5 + 1
    row = (np.arctan2(y, np.hypot(x, z)) / np.pi + 0.5) * height - 0.5
    round_about = np.concatenate([panorama[:, -1:], panorama, panorama[:, :1]], axis=1)
    return np.asarray(cv2.remap(round_about, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def views_of(
    pictures: Mapping[str, Path], *, max_side: int, work: Path, safe_point: Callable[[], None], progress: Callable[..., None], warn: Callable[[str], object]
) -> dict[str, Path]:
    """PNGs of the views of panoramas by name: that of the panorama, /, degrees to the right; without panoramas that cannot be read.

    work      scratch folder; what an earlier call left in it is used again
    """
    found: dict[str, Path] = {}
    warn_once = once(warn)
    for place, (name, path) in enumerate(pictures.items()):
        folder, done = work / f"panorama_{place}", work / f"panorama_{place}.json"
        targets = {f"{name}/{360 * view // VIEWS:03d}.png": folder / f"{view}.png" for view in range(VIEWS)}
        if noted(done, list[str], warn_once, same_as(list(targets))) is None:
            remove(folder)
            folder.mkdir(parents=True)
            try:
                pixels = read_photo(path, MAX_SIDE).rgb
            except UnreadableImage as error:
                warn(f"{name}: {error}; left out.")
                continue
            for view, target in enumerate(targets.values()):
                safe_point()
                _write(cut(pixels, view_side(pixels.shape[1], max_side), view), target)
            note(done, list(targets), list(targets.values()))
        progress(place + 1, len(pictures), "cutting panoramas")
        found |= targets
    return found


def _write(pixels: np.ndarray, path: Path) -> None:
    side = len(pixels)
    exif = Image.Exif()
    exif[Base.Make] = "panorama"
    exif[IFD.Exif] = {  # half a side is the focal length
        Base.FocalLength: 10.0, Base.FocalPlaneXResolution: side / 20, Base.FocalPlaneResolutionUnit: _MILLIMETRE, Base.ExifImageWidth: side,
    }  # fmt: skip
    write_png(pixels, path, compress_level=FAST, durable=False, exif=exif)
