"""Silhouettes of the foreground, for photographs of a thing in its surroundings: no turntable, no screen, no network.

    a first quick training of all that is seen -> the subject and what supports it -> how much of each pixel the subject covers -> silhouettes -> tests

Nothing is masked on a guess: where no subject stands out, or its silhouettes are not those of one compact thing, this is refused.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from efficientnerf.asset.field_samples import field_samples, picture_places, surface_points
from efficientnerf.capture.foreground import find_subject
from efficientnerf.capture.keying import large_parts
from pipeline.errors import BadInput, UsageError
from pipeline.stage import Job
from stages.artifacts import PosesOutputs
from stages.compiling import running_kernels
from stages.cores import count_cores, in_order
from stages.figures.plots import grid_sheet
from stages.formats.importers.source import MIN_IMAGES, abbreviated
from stages.framing.mask_use import LEAST_OVERLAP, MIN_AGREEING, alike, along_border, has_alpha, hull_overlaps
from stages.io.capture import FOREGROUND, Capture, Photo, without
from stages.io.photo import read_photo
from stages.io.pictures import UnreadableImage, grey_of, opened
from stages.masking.first_training import RAYS, SIDE, FirstField, first_field, first_training_needed
from stages.masking.made import with_masks, write_mask
from stages.masking.subject import Subject, coverage, subject_of
from stages.memory.need import refuse_what_does_not_fit
from stages.poses.memory import reading_threads
from stages.scratch import note, noted

# docs/experiments/silhouettes.md
LEAST_SAMPLE = 1e-3  # weight of a sample of the field that is looked at
PART = 0.05  # of the largest part of a silhouette, that others have which are kept
GAP = 0.002  # of the picture, up to which gaps in a silhouette are closed
AT_BORDER, MOST_CUT = 0.02, 0.5  # of the picture's border, from which a silhouette is cut off by it; share of the photographs in which it may be

OUTSIDE = np.array([255, 0, 255])  # of silhouettes in the sheet
MOST_SHEET = 60

REMEDY = (
    "Photograph it from all sides, complete in nearly all images, with nothing in front of it; or give your own masks in a folder masks/. Without --mask the"
    " whole scene is trained, and --region foreground shows and exports the subject and what it stands on."
)


class _Made(msgspec.Struct):
    """A note of finished masks: the file of each photograph that has one, by its name, and facts for the report."""

    masks: dict[str, str]
    facts: dict[str, Any]


def with_foreground_masks(job: Job, capture: Capture, warn: Any) -> Capture:
    """The capture with a silhouette of the foreground as the mask of each photograph that has a trustworthy one. Raises UsageError, BadInput."""
    own = [photo.camera.name for photo in capture.photos if photo.mask is not None or has_alpha(photo)]
    if own:
        text = f"--mask {FOREGROUND}: {len(own)} of {len(capture.photos)} photographs have a mask or an alpha channel already: {abbreviated(own)}."
        raise UsageError(f"{text} Omit --mask to use these, or remove them.")
    capture, images = _pictures(job, capture, warn)
    folder = job.work / "foreground"
    folder.mkdir(exist_ok=True)
    made = noted(folder / "made.json", _Made, job.warn)
    if made is None:
        found: list[_Made] = []

        @running_kernels
        def make(job: Job) -> None:
            refuse_what_does_not_fit(job, first_training_needed(len(images)), "Omit --mask foreground.")
            field = first_field(job, capture, images)
            found.append(_made(job, capture, field, _subject(field), folder))

        make(job)
        made = found[0]
        note(folder / "made.json", msgspec.to_builtins(made), [folder / file for file in made.masks.values()])
    masks = {name: folder / file for name, file in made.masks.items()}
    job.say(f"foreground silhouettes: {len(masks)} of {len(capture.photos)} photographs, overlap with their visual hull {made.facts['overlap']:.0%}")
    capture = with_masks(capture, masks)
    _draw(capture.photos, images, PosesOutputs(job.out).silhouettes)
    return replace(capture, facts={**capture.facts, FOREGROUND: made.facts})


def _pictures(job: Job, capture: Capture, warn: Any) -> tuple[Capture, list[np.ndarray]]:
    """The capture without the photographs that cannot be decoded, and the others at the size of the first training."""

    def read(photo: Photo) -> np.ndarray | UnreadableImage:
        try:
            return np.ascontiguousarray(read_photo(photo.image, SIDE).rgb)
        except UnreadableImage as error:
            return error

    threads = reading_threads(job, [(photo.camera.width, photo.camera.height) for photo in capture.photos], count_cores())
    found = list(in_order(read, capture.photos, threads, job.safe_point))
    images = [each for each in found if isinstance(each, np.ndarray)]
    failed = [(photo.camera.name, str(each)) for photo, each in zip(capture.photos, found, strict=True) if isinstance(each, UnreadableImage)]
    if failed:
        warn(f"{len(failed)} of {len(found)} images cannot be used: {abbreviated([f'{name} {why}' for name, why in failed])}. They are left out.")
    return without(capture, [index for index, each in enumerate(found) if isinstance(each, np.ndarray)], failed), images


def _subject(field: FirstField) -> Subject:
    """The subject of a first training. Raises BadInput."""
    samples = field_samples(field.model, field.pixels, RAYS, LEAST_SAMPLE, lambda done, total: None)
    points = surface_points(samples)
    found = find_subject(points, samples.view, picture_places(samples, field.pixels, slice(None)), field.cameras, weights=samples.opacity)
    if found is None or not len(found.subject):
        raise _refused("no subject stands out from what is round it")
    if not found.planes:
        raise _refused("nothing flat is found that the subject stands on")
    return subject_of(found, points)


def _made(job: Job, capture: Capture, field: FirstField, subject: Subject, folder: Path) -> _Made:
    """Masks of the photographs, in the folder, whose silhouettes are those of one compact thing. Raises BadInput."""
    small: list[tuple[Photo, np.ndarray]] = []
    for number, (photo, camera) in enumerate(zip(capture.photos, field.cameras, strict=True)):
        job.reached(number, len(capture.photos), "silhouettes of the foreground")
        small.append((photo, cleaned(coverage(field.model, subject, camera, field.near, field.far))))
    why_not, compact = alike(small)
    if why_not:
        raise _refused(why_not)
    cut = [photo.camera.name for photo, kept in compact if along_border(kept).mean() > AT_BORDER]
    if len(cut) > MOST_CUT * len(small):
        raise _refused(f"the border of the picture cuts off the silhouettes of {len(cut)} of {len(small)} photographs: {abbreviated(cut)}")
    overlap = hull_overlaps(capture, compact)
    fits = {photo.camera.name for (photo, _), each in zip(compact, overlap, strict=True) if each >= LEAST_OVERLAP}
    if len(fits) < max(MIN_IMAGES, MIN_AGREEING * len(small)):
        raise _refused(f"no thing has all of these silhouettes: {len(fits)} of {len(small)} fit to their visual hull")
    masks = {}
    for number, (photo, mask) in enumerate(small):
        if photo.camera.name in fits:
            job.safe_point()
            masks[photo.camera.name] = f"{number:05d}.png"
            write_mask(mask, (photo.camera.width, photo.camera.height), folder / masks[photo.camera.name])
    shares = [float(kept.mean()) for _, kept in compact]
    facts = {"photographs": len(masks), "overlap": round(float(np.median(overlap)), 3), "kept": [round(min(shares), 4), round(max(shares), 4)]}
    return _Made(masks, {**facts, "cut_by_border": cut, "supports": len(subject.planes)})


def cleaned(covered: np.ndarray) -> np.ndarray:
    """(H, W) uint8 of how much of each pixel is covered: without small parts and small gaps."""
    mask = np.round(np.clip(covered, 0, 1) * 255).astype(np.uint8)
    near = cv2.dilate(large_parts(mask >= 128, PART).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    mask[~near] = 0
    count, labels, stats, _ = cv2.connectedComponentsWithStats((mask < 128).astype(np.uint8), connectivity=4)
    gaps = [part for part in range(1, count) if stats[part, cv2.CC_STAT_AREA] <= GAP * mask.size]
    mask[np.isin(labels, gaps)] = 255
    return mask


def _draw(photos: Sequence[Photo], images: Sequence[np.ndarray], path: Path) -> None:
    """A sheet of photographs, (H, W, 3) uint8 each, in colour where their masks keep them; of many an even choice."""
    pictures, labels = [], []
    for photo, image in list(zip(photos, images, strict=True))[:: -(-len(photos) // MOST_SHEET)]:
        kept = np.zeros(image.shape[:2], np.uint8)
        if photo.mask is not None:
            with opened(photo.mask) as mask:
                kept = cv2.resize(grey_of(mask), (image.shape[1], image.shape[0]), interpolation=cv2.INTER_AREA)
        share = kept[..., None] / 255.0
        pictures.append(np.round(image * share + (1 - share) * OUTSIDE).astype(np.uint8))
        labels.append(f"{photo.camera.name}{'' if photo.mask else ' left out'}")
    count = sum(photo.mask is not None for photo in photos)
    grid_sheet(pictures, labels, path, title=f"{count} of {len(photos)} photographs with a silhouette of the foreground")


def _refused(why: str) -> BadInput:
    return BadInput(f"--mask {FOREGROUND}: {why}. {REMEDY}")
