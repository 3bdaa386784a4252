"""Which level of given masks is kept. White is, as nerfstudio, Brush and COLMAP have it; but masks of an object that was painted black are met with, too.

Masks that are white but for one compact thing in nearly all photographs either leave it out or show it the other way round. They show it where all of these
black shapes are views of one thing: these fit its visual hull, and shapes of moving things do not. docs/experiments/silhouettes.md
"""

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from pipeline.errors import BadInput
from pipeline.stage import Job
from stages.framing import scene_bounds
from stages.framing.mask_use import MIN_AGREEING, alike, share_that_fits
from stages.io.capture import Capture, Photo, Silhouettes
from stages.io.pictures import UnreadableImage, read_header
from stages.io.png import FAST, write_png
from stages.io.reader import PhotoReader
from stages.io.working_images import mask_levels
from stages.masking.background import photo_without_camera
from stages.masking.made import with_masks

INVERTED = "masks keep what is black; what is white is left out"
INVERTED_NOTICE = INVERTED + "; --set poses.mask_polarity=white reverses this"


def kept_white(job: Job, paths: Mapping[str, Path], masks: Mapping[str, Path], reader: PhotoReader) -> tuple[dict[str, Path], dict[str, Path]]:
    """The masks of photographs without cameras, each turned round where `poses.mask_polarity` says so. And all of them turned round where they look like
    it, and cameras have yet to show whether that is right; else none."""
    polarity = job.settings.mask_polarity
    if not masks or polarity == "white" or (polarity == "auto" and job.settings.masks == "ignore"):
        return dict(masks), {}
    photos = [photo for name in sorted(masks) if (photo := photo_without_camera(name, paths[name], masks[name])) is not None]
    if polarity == "black":
        job.say(INVERTED)
        return {**masks, **_turned_round(job, photos)}, {}
    return dict(masks), _turned_round(job, photos) if _look_inverted(photos, reader) else {}


def capture_kept_white(job: Job, capture: Capture, reader: PhotoReader) -> Capture:
    """The same of a capture with cameras; masks whose format says which level is left out (`Photo.mask_ignore`) stay."""
    polarity = job.settings.mask_polarity
    photos = [photo for photo in capture.photos if photo.mask is not None and photo.mask_ignore == "black"]
    if not photos or polarity == "white":
        return capture
    if polarity == "auto":
        if job.settings.masks == "ignore" or not _look_inverted(photos, reader):
            return capture
        flipped = replace(capture, photos=tuple(replace(photo, mask_ignore="white") for photo in photos))
        if share_that_fits(flipped, Silhouettes(masks=True), reader) < MIN_AGREEING:
            return capture
    job.say(INVERTED_NOTICE if polarity == "auto" else INVERTED)
    return with_masks(capture, _turned_round(job, photos))


def _look_inverted(photos: Sequence[Photo], reader: PhotoReader) -> bool:
    """Whether masks leave out one compact thing in nearly all photographs, and do not keep one."""
    chosen = scene_bounds.chosen_photos(photos)
    if not alike([(photo, reader.mask(photo)) for photo in chosen])[0]:
        return False
    return not alike([(photo, reader.mask(replace(photo, mask_ignore="white"))) for photo in chosen])[0]


def _turned_round(job: Job, photos: Sequence[Photo]) -> dict[str, Path]:
    """Name -> mask with black and white exchanged, in the scratch folder; those that cannot be used are left out, and reported where they are read."""
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
