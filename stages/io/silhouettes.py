"""Alpha channels and masks of photographs at small size: enough to separate an object from the rest, and to bound it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from stages.io.capture import Photo, Silhouettes
from stages.io.photo import read_alpha
from stages.io.pictures import UnreadableImage, read_header
from stages.io.working_images import TRANSPARENT, mask_levels

SMALL = 160  # px, longest side


@dataclass
class SmallPictures:
    """Alpha channels and masks of photographs (h, w) uint8, upright, longest side at most `SMALL`, the highest of each block; each file is read once.

    Pixels up to `TRANSPARENT` are 0. None where a photograph has none, or it cannot be read, which is reported where it is needed.
    """

    _alpha: dict[Path, np.ndarray | None] = field(default_factory=dict)
    _masks: dict[Path, np.ndarray | None] = field(default_factory=dict)

    def alpha(self, photo: Photo) -> np.ndarray | None:
        if photo.image not in self._alpha:
            self._alpha[photo.image] = _alpha_of(photo)
        return self._alpha[photo.image]

    def mask(self, photo: Photo) -> np.ndarray | None:
        """Of its mask file, as a silhouette."""
        if photo.mask is None:
            return None
        if photo.image not in self._masks:
            self._masks[photo.image] = _mask_of(photo)
        return self._masks[photo.image]

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


def _alpha_of(photo: Photo) -> np.ndarray | None:
    try:
        if not read_header(photo.image).alpha:
            return None
        alpha = read_alpha(photo.image)
    except UnreadableImage:
        return None
    return None if alpha is None else reduced(alpha)


def _mask_of(photo: Photo) -> np.ndarray | None:
    try:
        levels = mask_levels(photo, read_header(photo.image).orientation)[0]
    except UnreadableImage:
        return None
    size = photo.camera.width, photo.camera.height
    if levels.shape[::-1] != size:
        levels = np.asarray(cv2.resize(levels, size, interpolation=cv2.INTER_NEAREST))
    return reduced(levels)


def reduced(levels: np.ndarray) -> np.ndarray:
    """(h, w) the greatest of each block of the levels (H, W), longest side at most `SMALL`; the last blocks are filled up with nothing."""
    levels = np.where(levels > TRANSPARENT, levels, np.uint8(0))
    factor = -(-max(levels.shape) // SMALL)
    height, width = -(-levels.shape[0] // factor) * factor, -(-levels.shape[1] // factor) * factor
    if (height, width) != levels.shape:
        # Whole blocks only, which moves nothing by more than a pixel.
        levels = np.pad(levels, ((0, height - levels.shape[0]), (0, width - levels.shape[1])))
    return np.asarray(levels.reshape(height // factor, factor, width // factor, factor).max((1, 3)))
