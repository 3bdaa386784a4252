"""Whether photographs with silhouettes show a background that moves with the object, in which features help, or one that stands still while it turns.

Where the camera goes round an object, its surroundings give features, and the object alone often too few. Where the object turns before a camera on a stand,
the background shows no motion. docs/experiments/silhouettes.md
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from efficientnerf.geometry.cameras import Camera
from stages.framing.mask_use import alike
from stages.framing.scene_bounds import chosen_photos
from stages.io.capture import Photo, Silhouettes
from stages.io.pictures import UnreadableImage, read_header
from stages.io.reader import SMALL, PhotoReader

MAX_PAIRS = 24  # of photographs that follow each other
FINE = 4.0  # px at `SMALL`, standard deviation of the blur that separates texture from shading
MIN_CORRELATION = 0.5  # correlation of the texture of two photographs, from which the background is the same
MIN_TEXTURE = 1.0  # of 255, standard deviation


def silhouettes_with_surroundings(
    paths: Mapping[str, Path], masks: Mapping[str, Path], choice: str, reader: PhotoReader, safe_point: Callable[[], None]
) -> Silhouettes:
    """Which of masks and alpha channels are silhouettes before a background in which features should be looked for, too; of alpha channels where colours
    were left below what is transparent.

    paths, masks  file of each photograph, and of its mask, by name
    """
    photos = [photo for name in sorted(paths) if (photo := photo_without_camera(name, paths[name], masks.get(name))) is not None]
    kind = Silhouettes(alpha=not masks, masks=bool(masks))
    pictures = [] if choice == "ignore" else [(photo, reader.mask(photo) if masks else reader.alpha(photo)) for photo in chosen_photos(photos)]
    if all(picture is None for _, picture in pictures) or (choice == "auto" and alike(pictures)[0]):
        return Silhouettes()
    return Silhouettes() if stands_still(photos, kind, reader, safe_point) else kind


def stands_still(photos: Sequence[Photo], kind: Silhouettes, reader: PhotoReader, safe_point: Callable[[], None]) -> bool:
    """Whether what lies outside of the silhouettes is the same in photographs that follow each other, or has no texture at all."""
    found: list[float] = []
    for index in range(0, len(photos) - 1, -(-len(photos) // MAX_PAIRS)):
        safe_point()
        pair = []
        for photo in photos[index : index + 2]:
            mask = reader.mask(photo) if kind.masks else reader.alpha(photo)
            try:
                grey = reader.photo(photo.image, SMALL).rgb().astype(np.float32).mean(2)
            except UnreadableImage:
                continue
            if mask is None:
                continue
            mask = cv2.resize(mask, grey.shape[::-1], interpolation=cv2.INTER_NEAREST)
            outside = (cv2.dilate((mask > 0).astype(np.uint8), np.ones((5, 5), np.uint8)) == 0).astype(np.float32)
            smooth = cv2.GaussianBlur(grey * outside, (0, 0), FINE) / np.maximum(cv2.GaussianBlur(outside, (0, 0), FINE), 1e-3)
            pair.append((grey - smooth, outside > 0))
        if len(pair) == 2 and pair[0][0].shape == pair[1][0].shape:
            outside = pair[0][1] & pair[1][1]
            one, other = (texture[outside] for texture, _ in pair)
            if outside.any() and min(one.std(), other.std()) >= MIN_TEXTURE:
                found.append(float(np.corrcoef(one, other)[0, 1]))
    return not found or float(np.median(found)) >= MIN_CORRELATION


def photo_without_camera(name: str, image: Path, mask: Path | None) -> Photo | None:
    """A photo whose camera has its size alone; None where it cannot be read."""
    try:
        width, height = read_header(image).size
    except UnreadableImage:
        return None
    return Photo(Camera(name, width, height, "SIMPLE_PINHOLE", (float(width), width / 2, height / 2), np.eye(4)), image, mask)
