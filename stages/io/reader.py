"""What a stage reads of photographs, each decoded once for a size: the photographs at working sizes, their alpha channels and masks at a small one."""

import contextlib
import hashlib
import os
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import cv2
import msgspec
import numpy as np

from stages.io.capture import Photo, Silhouettes
from stages.io.photo import PhotoDetails, read_photo
from stages.io.pictures import UnreadableImage, read_header
from stages.io.png import FAST, read_png, write_png
from stages.io.working_images import TRANSPARENT, decode, mask_levels
from stages.scratch import note, noted

SMALL = 160  # px, longest side


@dataclass(frozen=True, eq=False)
class KeptPhoto:
    """A photograph in the scratch folder."""

    details: PhotoDetails
    image: Path  # PNG of its pixels, 8 bits sRGB, after EXIF rotation, at working size
    opaque: Path | None  # PNG that is black where the file's alpha is below one half; None without transparent pixels
    decoded: np.ndarray | None = None  # its pixels, where it has just been decoded

    def rgb(self) -> np.ndarray:
        """(h, w, 3) uint8 sRGB."""
        return read_png(self.image) if self.decoded is None else self.decoded


@dataclass
class PhotoReader:
    """
    Alpha channels and masks are (h, w) uint8, upright, longest side at most `SMALL`, the highest of each block; pixels up to `TRANSPARENT` are 0. None where
    a photograph has none, or it cannot be read, which is reported where it is needed.
    """

    folder: Path | None = None  # in the stage's scratch, for photographs at working sizes; None where masks alone are read
    _alpha: dict[Path, np.ndarray | None] = field(default_factory=dict)
    _masks: dict[tuple[Path, str, str], np.ndarray | None] = field(default_factory=dict)

    def photo(self, path: Path, max_side: int) -> KeptPhoto:
        """The photograph, longest side at most `max_side`. Raises UnreadableImage."""
        assert self.folder is not None
        place = self.folder / _key(path, max_side)
        image, mask, record = (place.with_suffix(suffix) for suffix in (".png", ".opaque.png", ".json"))
        found = noted(record, _Note, lambda text: None)  # what is damaged is decoded again
        if found is not None:
            return KeptPhoto(found.details, image, mask if found.transparent else None)
        photo = read_photo(path, max_side)
        self.folder.mkdir(parents=True, exist_ok=True)
        kept = KeptPhoto(PhotoDetails(**{each.name: getattr(photo, each.name) for each in fields(PhotoDetails)}), image, None, photo.rgb)
        write_png(photo.rgb, image, compress_level=FAST, durable=False)
        if photo.opaque is not None:
            kept = replace(kept, opaque=mask)
            write_png(np.where(photo.opaque, np.uint8(255), np.uint8(0)), mask, compress_level=FAST, durable=False)
        note(record, msgspec.to_builtins(_Note(kept.details, kept.opaque is not None)), [each for each in (image, kept.opaque) if each])
        return kept

    def alpha(self, photo: Photo) -> np.ndarray | None:
        if photo.image not in self._alpha:
            found = None
            with contextlib.suppress(UnreadableImage):
                if read_header(photo.image).alpha and (pixels := decode(photo.image, as_stored=True).pixels).shape[2] == 4:
                    found = reduced(pixels[..., 3])
            self._alpha[photo.image] = found
        return self._alpha[photo.image]

    def mask(self, photo: Photo) -> np.ndarray | None:
        """Of its mask file, as a silhouette."""
        if photo.mask is None:
            return None
        key = photo.image, _key(photo.mask, SMALL), photo.mask_ignore
        if key not in self._masks:
            found = None
            with contextlib.suppress(UnreadableImage):
                levels, size = mask_levels(photo, read_header(photo.image).orientation)[0], (photo.camera.width, photo.camera.height)
                found = reduced(levels if levels.shape[::-1] == size else np.asarray(cv2.resize(levels, size, interpolation=cv2.INTER_NEAREST)))
            self._masks[key] = found
        return self._masks[key]

    def silhouette(self, photo: Photo, silhouettes: Silhouettes) -> np.ndarray | None:
        """(h, w) bool: whether any pixel below is covered; None without a silhouette, or where nothing is transparent.

        In a capture without silhouettes it is that of the alpha channel.
        """
        alpha = self.alpha(photo) if silhouettes.alpha or not silhouettes.masks else None
        mask = self.mask(photo) if silhouettes.masks else None
        if alpha is not None and mask is not None and alpha.shape == mask.shape:
            alpha = np.minimum(alpha, mask)
        found = alpha if alpha is not None else mask
        return None if found is None or (found > 0).all() else found > 0


@dataclass(frozen=True)
class _Note:
    details: PhotoDetails
    transparent: bool


def _key(path: Path, max_side: int) -> str:
    """A file name that stands for a file as it is now, and a size."""
    try:
        about = path.stat()
        state = about.st_size, about.st_mtime_ns, about.st_ino
    except OSError:  # reading it says why
        state = 0, 0, 0
    return hashlib.sha256(repr((os.fspath(path), *state, max_side)).encode()).hexdigest()[:32]


def reduced(levels: np.ndarray) -> np.ndarray:
    """(h, w) the greatest of each block of the levels (H, W), longest side at most `SMALL`; the last blocks are filled up with nothing."""
    levels = np.where(levels > TRANSPARENT, levels, np.uint8(0))
    factor = -(-max(levels.shape) // SMALL)
    height, width = -(-levels.shape[0] // factor) * factor, -(-levels.shape[1] // factor) * factor
    if (height, width) != levels.shape:
        # Whole blocks only, which moves nothing by more than a pixel.
        levels = np.pad(levels, ((0, height - levels.shape[0]), (0, width - levels.shape[1])))
    return np.asarray(levels.reshape(height // factor, factor, width // factor, factor).max((1, 3)))
