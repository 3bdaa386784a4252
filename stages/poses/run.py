"""The poses stage: a source in any format becomes a scene that needs the source no more.

    detect the format -> read the cameras, or find them -> working images -> training frame -> splits -> write

Images are not undistorted: later stages trace the distorted rays.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import to_builtins

from efficientnerf.geometry.cameras import resized
from efficientnerf.settings import resolved
from pipeline.errors import BadInput
from pipeline.files import write_json
from pipeline.stage import Job
from stages.artifacts import PosesOutputs
from stages.cores import count_cores, in_order
from stages.figures.contact_sheet import write_contact_sheet
from stages.formats import importers
from stages.formats.importers.source import MIN_IMAGES, abbreviated
from stages.framing import training_frame
from stages.framing.markers import with_markers
from stages.framing.mask_use import MaskUse, doubts, find_mask_use, points_of_object, without_silhouette
from stages.framing.upward import with_up
from stages.io import working_images
from stages.io.capture import FOREGROUND, Capture, Photo, without
from stages.io.pictures import UnreadableImage
from stages.io.reader import PhotoReader
from stages.io.scene import SPLITS, Scene, View, save, save_points
from stages.masking.made import with_masks
from stages.masking.photographs import cameras_of_photographs, mask_choice, masks_made_for
from stages.masking.polarity import capture_kept_white
from stages.memory.need import refuse_what_does_not_fit
from stages.poses.memory import decoding_needed, reading_threads
from stages.poses.settings import PosesSettings
from stages.verdict.writing import judge

WHITE = (1.0, 1.0, 1.0)  # what Realistic Synthetic is composited on for every published figure


def run(job: Job) -> None:
    """Write scene.json, images/, masks/, points.safetensors, verdict.json, pictures and report.json. Raises BadInput."""
    settings: PosesSettings = job.settings
    if job.source is None:
        raise BadInput("the poses stage needs a source: give a folder of photographs, a video, or a posed data set.")
    notes: list[str] = []

    def warn(text: str, **facts: Any) -> None:
        notes.append(text)
        job.warn(text, **facts)

    reader = PhotoReader(job.work / "photographs")
    capture = read(job, settings, reader, warn)
    job.say(f"{len(capture.photos)} images, {capture.kind}", kind=capture.kind, images=len(capture.photos))
    sizes = [(photo.camera.width, photo.camera.height) for photo in capture.photos]
    refuse_what_does_not_fit(job, decoding_needed(sizes), "Reduce the largest photographs.")
    if settings.marker_size != "off":
        capture = with_markers(job, capture, settings.marker_size, warn)
    capture = with_up(capture, settings.up, job.say, warn)
    capture, use = with_mask_use(job, capture, reader, warn)
    capture, written = _write_images(job, capture, warn)
    judged = capture  # by all sparse points that its cameras were found with
    if capture.silhouettes and capture.points is not None:  # sparse points that lie outside of silhouettes are left out
        capture = replace(capture, points=capture.points.only(np.flatnonzero(points_of_object(capture, reader))))
    framed = training_frame.find_training_frame(
        capture, up=settings.up, box=resolved(settings.crop_box), margin=settings.box_margin, space=settings.space, reader=reader
    )
    if names := framed.silhouettes_cut:
        warn(f"the silhouettes of {len(names)} photographs extend beyond the box: {abbreviated(names)}. What is outside is cut off. Set poses.crop_box.")
    splits = assign_splits(capture.photos, settings.test_every, warn)
    world = framed.world_from_capture
    views = _views(capture, written, splits, framed)
    if capture.points is not None:
        save_points(replace(capture.points, xyz=world.points(capture.points.xyz)), job.out)
    scene = Scene(
        kind=capture.kind,
        views=views,
        bounds=framed.bounds,
        background=capture.background,
        world_from_capture=world,
        orbit=framed.orbit,
        points=capture.points is not None,
        metric=capture.metric,
        space=framed.space,
        forward=framed.forward,
    )
    save(scene, job.out)
    judge(job, judged, scene, _may_be_renders(capture), warn)
    _write_report(PosesOutputs(job.out).report, capture, scene, framed, use, notes)
    job.safe_point()
    write_contact_sheet(scene, job.out, capture.rejected, capture.rejected_files)


def _views(capture: Capture, written: Sequence[Any], splits: Sequence[str], framed: training_frame.TrainingFrame) -> tuple[View, ...]:
    """Of the photographs, in the training frame."""
    world = framed.world_from_capture
    return tuple(
        View(
            image=files.image,
            mask=files.mask,
            split=split,
            camera=world.camera(resized(photo.camera, files.width, files.height)),
            source_camera=photo.camera,
            near=float(near),
            far=float(far),
        )
        for photo, files, split, (near, far) in zip(capture.photos, written, splits, framed.near_far_planes, strict=True)
    )


def read(job: Job, settings: PosesSettings, reader: PhotoReader, warn: Any) -> Capture:
    """The capture of the job's source, by structure from motion where the format states no cameras. Raises BadInput."""
    assert job.source is not None
    possible: list[str] = []
    for path in job.sources.values():
        possible = importers.formats_of(path, settings)
        if len(job.sources) > 1 and possible[0] != "photographs":
            remedy = "Give it alone, or use --as photographs to find all cameras anew."
            raise BadInput(f"{path}: is read as {possible[0]}; several sources can only be photographs and videos. {remedy}")
    name = possible[0]
    if len(possible) > 1 and possible[1:] != ["photographs"]:
        warn(f"{job.source} is read as {name}; it could also be {', '.join(possible[1:])}. Choose with --as.")
    if importers.IMPORTERS[name].posed:
        capture = importers.IMPORTERS[name].read(job.source, settings)
        for sentence in capture.warnings:
            warn(sentence)
        capture = capture_kept_white(job, capture, reader)
        made = masks_made_for(job, {photo.camera.name: photo.image for photo in capture.photos if photo.mask is None}, warn)
        capture = with_masks(capture, made)
    else:
        capture = cameras_of_photographs(job, reader, warn)
    if settings.mask_from == FOREGROUND:
        from stages.masking.foreground import with_foreground_masks  # trains a field, for which the stage needs no torch else

        capture = with_foreground_masks(job, capture, warn)
    if settings.strict and capture.rejected:
        which = abbreviated([f"{image} ({why})" for image, why in capture.rejected])
        raise BadInput(f"{job.source}: {len(capture.rejected)} images cannot be used: {which}. Refused by --strict.")
    return capture


def with_mask_use(job: Job, capture: Capture, reader: PhotoReader, warn: Any) -> tuple[Capture, MaskUse]:
    """The capture with what its masks and alpha channels mean, without the images of which nothing says what is background; and that meaning."""
    renders = _may_be_renders(capture)
    use = find_mask_use(capture, mask_choice(job.settings, capture.provenance), renders, reader, job.safe_point)
    for sentence in use.sentences:
        job.say(sentence)
    for sentence in doubts(use):
        warn(sentence)
    names = set(without_silhouette(capture.photos, use.silhouettes))
    if names:
        warn(f"{len(names)} of {len(capture.photos)} images have no silhouette, unlike the others: {abbreviated(sorted(names))}. They are left out.")
    kept = [index for index, photo in enumerate(capture.photos) if photo.camera.name not in names]
    capture = without(capture, kept, [(name, "has no silhouette, and the others do") for name in sorted(names)])
    if not use.silhouettes:
        return replace(capture, background=None), use
    return replace(capture, background=WHITE, silhouettes=use.silhouettes), use


def _may_be_renders(capture: Capture) -> bool:
    return capture.kind in importers.IMPORTERS and importers.IMPORTERS[capture.kind].renders


def _write_images(job: Job, capture: Capture, warn: Any) -> tuple[Capture, list[Any]]:
    """Write the working images. Returns the capture without the images that cannot be decoded, and what was written for the others."""
    relative = working_images.image_paths([photo.camera for photo in capture.photos])
    how: dict[str, Any] = {"max_side": job.settings.max_image_size, "silhouettes": capture.silhouettes, "may_be_empty": _may_be_renders(capture)}
    kept: list[int] = []
    written = []
    failed: list[tuple[str, str]] = []
    remarks: list[str] = []

    def write(index: int) -> working_images.Written | UnreadableImage:
        try:
            return working_images.write(capture.photos[index], job.out, relative[index], **how)
        except UnreadableImage as error:
            return error

    threads = reading_threads(job, [(photo.camera.width, photo.camera.height) for photo in capture.photos], count_cores())
    for index, found in enumerate(in_order(write, range(len(capture.photos)), threads, job.safe_point)):
        job.progress(index, len(capture.photos), "preparing images")
        if isinstance(found, UnreadableImage):
            failed.append((capture.photos[index].camera.name, str(found)))
        else:
            written.append(found)
            remarks += found.warnings
            kept.append(index)
    job.progress(len(capture.photos), len(capture.photos), "preparing images")
    if failed:
        sentence = f"{len(failed)} of {len(capture.photos)} images cannot be used: {abbreviated([f'{name} {reason}' for name, reason in failed])}."
        if len(kept) < MIN_IMAGES or job.settings.strict:
            why = "Refused by --strict." if len(kept) >= MIN_IMAGES else f"{len(kept)} remain; at least {MIN_IMAGES} are needed."
            raise BadInput(f"{job.source}: {sentence} {why} Copy or convert them again, or take them out.")
        warn(f"{sentence} They are left out.")
    for sentence in [*remarks[:3], *([f"... and {len(remarks) - 3} more like these."] if len(remarks) > 3 else [])]:
        warn(sentence)
    return without(capture, kept, failed), written


def assign_splits(photos: Sequence[Photo], every: int, warn: Any = lambda text: None) -> list[str]:
    """The split of each photo: the source's where it states validation or test images, else every n-th in sorted order is a test image.

    Fewer than twice n are counted from the middle: the first and the last photograph along an arc show what no other does.
    At least 2 are left for training, whatever the source states.
    """
    given = [photo.split for photo in photos]
    if any(split in ("val", "test") for split in given):
        splits = [split or "train" for split in given]
        if splits.count("train") >= 2:
            unlisted = given.count(None)
            if unlisted:
                warn(f"{unlisted} images are in none of the source's splits; they are used for training.")
            return splits
        warn(f"The source's split has {splits.count('train')} training images; at least 2 are needed. The split is not used.")
    order = sorted(range(len(photos)), key=lambda index: photos[index].camera.name)
    first = 0 if len(photos) >= 2 * every else min(every, len(photos)) // 2
    test = set(order[first::every][: max(0, len(photos) - 2)])
    return ["test" if index in test else "train" for index in range(len(photos))]


def _write_report(path: Path, capture: Capture, scene: Scene, framed: training_frame.TrainingFrame, use: MaskUse, notes: Sequence[str]) -> None:
    """Images used and rejected, splits, facts and warnings."""
    report = {
        "kind": capture.kind,
        "registered": [
            {"name": view.name, "split": view.split, "image": view.image, "mask": view.mask, "size": [view.camera.width, view.camera.height]}
            for view in scene.views
        ],
        "rejected": [{"name": name, "reason": reason} for name, reason in capture.rejected],
        "splits": {split: count for split, count in Counter(view.split for view in scene.views).items() if split in SPLITS},
        "reprojection_error": capture.reprojection_error,
        "points": 0 if capture.points is None else len(capture.points.xyz),
        "background": capture.background,
        "framing": framed.facts,
        "masks": use.facts,
        "facts": to_builtins(capture.provenance) | capture.facts,
        "warnings": list(notes),
    }
    write_json(path, report, default=str)
