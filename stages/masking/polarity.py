"""Masks that keep what is black, turned round where `poses.mask_polarity` says so: all else keeps white, as nerfstudio, Brush and COLMAP have it."""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from pipeline.errors import BadInput
from pipeline.stage import Job
from stages.io.capture import Capture, Photo
from stages.io.pictures import UnreadableImage, read_header
from stages.io.png import FAST, write_png
from stages.io.working_images import mask_levels
from stages.masking.background import photo_without_camera

INVERTED = "masks keep what is black; what is white is left out"


def kept_white(job: Job, paths: Mapping[str, Path], masks: Mapping[str, Path]) -> dict[str, Path]:
    """The masks of photographs without cameras, by name, turned round where they keep black."""
    if not masks or job.settings.mask_polarity == "white":
        return dict(masks)
    photos = [photo for name in sorted(masks) if (photo := photo_without_camera(name, paths[name], masks[name])) is not None]
    return {**masks, **_turned_round(job, photos)}


def capture_kept_white(job: Job, capture: Capture) -> Capture:
    """The same of a capture with cameras; masks whose format says which level is left out (`Photo.mask_ignore`) stay."""
    photos = [photo for photo in capture.photos if photo.mask is not None and photo.mask_ignore == "black"]
    if not photos or job.settings.mask_polarity == "white":
        return capture
    masks = _turned_round(job, photos)
    return replace(capture, photos=tuple(replace(photo, mask=masks.get(photo.camera.name, photo.mask)) for photo in capture.photos))


def _turned_round(job: Job, photos: Sequence[Photo]) -> dict[str, Path]:
    """Name -> mask with black and white exchanged, in the scratch folder; those that cannot be used are left out, and reported where they are read."""
    job.say(INVERTED)
    folder = job.work / "masks_turned_round"
    folder.mkdir(parents=True, exist_ok=True)
    made = {}
    for number, photo in enumerate(photos):
        job.safe_point()
        with contextlib.suppress(UnreadableImage, BadInput):
            levels = mask_levels(replace(photo, mask_ignore="white"), read_header(photo.image).orientation)[0]
            write_png(levels, folder / f"{number:05d}.png", compress_level=FAST, durable=False)
            made[photo.camera.name] = folder / f"{number:05d}.png"
    return made
