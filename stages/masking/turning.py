"""Whether a subject turned before a camera on a stand: the background stays where it is, and the subject shows one side after the other.

Two signs are checked before cameras are searched for: texture along the picture's border that recurs, pixel by pixel, in photographs that are far apart
in the sequence; and something compact in the middle that does not. A camera that moves past a far background shows the same. So it is certain only afterwards:
cameras found by the subject alone look at it from sides from which no camera could have seen the same background.
docs/experiments/sfm.md
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pipeline.errors import BadInput
from stages.framing.mask_use import alike
from stages.io.capture import Photo
from stages.io.pictures import UnreadableImage, read_header
from stages.io.reader import PhotoReader
from stages.masking.background import FINE, MIN_TEXTURE, photo_without_camera
from stages.masking.made import STATIC, made_masks
from stages.masking.static import border_of

SIDE = 320  # px, longest side of the photographs whose borders are compared
MIN_PHOTOGRAPHS, COMPARED = 8, 6  # photographs; those that are compared, far apart
MIN_CORRELATION, MIN_STILL_PAIRS = 0.7, 0.8  # correlation of the texture of two borders, from which they stand still; share of the pairs that do
MIN_OF_ONE_SIZE = 0.9  # of the photographs
MIN_TURN = 15.0  # degrees between two view directions


def masks_of_turning_subject(
    paths: Mapping[str, Path], folder: Path, reader: PhotoReader, *, safe_point: Callable[[], None], progress: Callable[..., None]
) -> dict[str, Path]:
    """Name -> mask, written to a folder, of a subject that probably turns before a background that stands still; none where nothing says so."""
    if not border_stands_still(paths, reader, safe_point):
        return {}
    try:
        masks = made_masks(paths, STATIC, folder, safe_point=safe_point, progress=progress, warn=lambda *_, **__: None)
    except BadInput:  # no background that recurs
        return {}
    photos = [photo for name in sorted(masks) if (photo := photo_without_camera(name, paths[name], masks[name])) is not None]
    return {} if len(masks) < MIN_OF_ONE_SIZE * len(paths) or alike([(photo, reader.mask(photo)) for photo in photos])[0] else masks


def border_stands_still(paths: Mapping[str, Path], reader: PhotoReader, safe_point: Callable[[], None]) -> bool:
    """Whether photographs of one size, far apart in the order of their names, have texture along their border, and the same."""
    names = sorted(paths)
    sizes = []
    for name in names:
        safe_point()
        try:
            header = read_header(paths[name])
        except UnreadableImage:
            continue
        if header.alpha:
            return False  # cut out already
        sizes.append((header.size, name))
    usual = max({size for size, _ in sizes}, key=[size for size, _ in sizes].count, default=None)
    chosen = [name for size, name in sizes if size == usual]
    if len(chosen) < max(MIN_PHOTOGRAPHS, MIN_OF_ONE_SIZE * len(names)):
        return False
    borders: list[np.ndarray] = []
    for index in np.linspace(0, len(chosen) - 1, COMPARED).astype(int):
        safe_point()
        try:
            grey = reader.photo(paths[chosen[index]], SIDE).rgb().astype(np.float32).mean(2)
        except UnreadableImage:
            return False
        texture = (grey - cv2.GaussianBlur(grey, (0, 0), FINE))[border_of(grey.shape)]
        if texture.std() < MIN_TEXTURE:
            return False
        borders.append(texture)
        if len(borders) == 2 and _correlation(*borders) < MIN_CORRELATION:
            return False  # of nearly all captures: what follows costs time
    pairs = [_correlation(one, other) >= MIN_CORRELATION for k, one in enumerate(borders) for other in borders[k + 1 :]]
    return float(np.mean(pairs)) >= MIN_STILL_PAIRS


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.corrcoef(one, other)[0, 1]) if one.shape == other.shape else 0.0


def turn(photos: Sequence[Photo]) -> float:
    """The largest angle between two view directions, degrees; 0 of no photographs."""
    if not photos:
        return 0.0
    forward: Any = np.array([photo.camera.forward for photo in photos])
    return float(np.degrees(np.arccos(np.clip((forward @ forward.T).min(), -1, 1))))
