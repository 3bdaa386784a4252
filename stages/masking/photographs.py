"""Cameras of photographs that state none: found by what masks keep, or by all that the photographs show, whichever the camera moved past."""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from msgspec import structs

from efficientnerf.settings import resolved
from pipeline.errors import BadInput, UsageError
from pipeline.stage import Job
from stages.cores import count_cores
from stages.formats.importers import IMPORTERS, posed_format
from stages.framing.gps import with_gps, with_stated_cameras
from stages.framing.markers import find_markers
from stages.framing.mask_use import MIN_AGREEING, share_that_fits
from stages.io.capture import FOREGROUND, Capture, Markers, Provenance, Silhouettes
from stages.io.material import photographs_of
from stages.io.pictures import UnreadableImage, read_header
from stages.io.reader import PhotoReader
from stages.masking.backdrop import without_white_backdrop
from stages.masking.background import silhouettes_with_surroundings
from stages.masking.made import made_masks, masks_by_network, with_masks
from stages.masking.polarity import INVERTED_NOTICE, kept_white
from stages.masking.turning import MIN_TURN, masks_of_turning_subject, turn
from stages.poses.memory import feature_threads
from stages.sfm.added.networks import given_networks
from stages.sfm.attempts import MIN_REGISTERED
from stages.sfm.cameras import find_cameras
from stages.sfm.images import Callables
from stages.sfm.pairs import features_for
from stages.sfm.reconstruction import Request

Find = Callable[[str, Mapping[str, Path | None]], Capture]


def cameras_of_photographs(job: Job, reader: PhotoReader, warn: Any) -> Capture:
    """The capture of the job's photographs and videos. Raises BadInput."""
    found = photographs_of(job, warn)
    paths, settings = found.paths, job.settings
    sizes = {}
    for name, path in paths.items():
        job.safe_point()
        with contextlib.suppress(UnreadableImage):  # reported where it is read
            sizes[name] = read_header(path).size
    markers = None if settings.marker_size == "off" else find_markers(job, {name: (paths[name], size) for name, size in sizes.items()})
    find = _search(job, paths, reader, warn, [*sizes.values()], markers)
    given, inverted = kept_white(job, paths, found.masks, reader)
    masks = {**given, **masks_made_for(job, {name: path for name, path in paths.items() if name not in found.masks}, warn)}
    guessed = not masks and settings.mask_from == "auto" and settings.masks != "ignore"
    capture, seen = _of_turning_subject(job, find, paths, reader) if guessed else (None, False)
    if capture is None:
        capture = _by_masks(job, find, paths, masks, inverted, reader)
        if guessed and not seen:
            capture = without_white_backdrop(job, capture, paths, reader, warn)
    if seen:
        capture = replace(capture, provenance=structs.replace(capture.provenance, background="stands still"))
    capture, sentences = _in_known_frame(job, capture, paths)
    for sentence in sentences:
        job.say(sentence)
    return replace(capture, rejected_files={name: paths[name] for name, _ in capture.rejected}, markers=markers)


def _in_known_frame(job: Job, capture: Capture, paths: Mapping[str, Path]) -> tuple[Capture, list[str]]:
    """The capture in the frame of cameras that the source states, where it is read as photographs in spite of them; else by GPS; and sentences to report."""
    sentences, source = [], job.source
    assert source is not None
    name = posed_format(source, job.settings) if len(job.sources) == 1 else None
    if name is not None:
        try:
            capture, sentence = with_stated_cameras(capture, IMPORTERS[name].read(source, job.settings))
            sentences.append(sentence)
        except BadInput as error:
            sentences.append(f"the source's cameras cannot be read and are not used: {error}")
        stated = capture.provenance.stated_cameras
        if stated is not None and stated.used != "nothing":
            return capture, sentences
    capture, sentence = with_gps(capture, paths)
    return capture, [*sentences, sentence] if sentence else sentences


def _by_masks(job: Job, find: Find, paths: Mapping[str, Path], masks: Mapping[str, Path], inverted: Mapping[str, Path], reader: PhotoReader) -> Capture:
    """The capture of photographs with these masks; with the inverted ones in their place where these are silhouettes of one thing."""

    def search(masks: Mapping[str, Path]) -> Capture:
        kind = silhouettes_with_surroundings(paths, masks, mask_choice(job.settings, Provenance()), reader, job.safe_point)
        # Alpha channels leave pixels out where these are no silhouettes.
        return _found_by_surroundings(job, find, kind, masks, {} if kind.masks else dict.fromkeys(paths), reader) if kind else find("cameras", masks)

    def fit(capture: Capture) -> bool:
        """Whether the masks of nearly all photographs are silhouettes of one thing."""
        return share_that_fits(capture, Silhouettes(masks=True), reader) >= MIN_AGREEING

    if not inverted:
        return search(masks)
    try:
        capture = search(masks)
    except BadInput:  # what surrounds a subject that turned stands still
        other = None
        with contextlib.suppress(BadInput):
            other = search(inverted)
        if other is None or not fit(other):
            raise
    else:
        other = with_masks(capture, {**dict.fromkeys(masks), **inverted})
        if not fit(other):
            return capture
    job.say(INVERTED_NOTICE)
    return other


def masks_made_for(job: Job, paths: Mapping[str, Path], warn: Any) -> dict[str, Path]:
    """Masks made for these photographs, by name, as `poses.mask_from` and `poses.mask_model` say."""
    how, network, folder = job.settings.mask_from, job.settings.mask_model, job.work / "masks"
    callables = Callables(safe_point=job.safe_point, progress=job.progress, warn=warn)
    if not paths:
        return {}
    if network != "off":
        if how not in ("auto", "off"):
            raise UsageError(f"--mask {how} and --mask-model: masks are made in one way. Give one of them.")
        return masks_by_network(paths, Path(network), folder, **callables)
    return {} if how in ("auto", "off", FOREGROUND) else made_masks(paths, how, folder, **callables)  # the foreground needs cameras


def mask_choice(settings: Any, provenance: Provenance) -> str:
    """The meaning of masks: those made of a background, or by a network, are silhouettes."""
    made = settings.mask_from not in ("auto", "off") or settings.mask_model != "off" or provenance.background in ("left out", "white")
    return "silhouette" if made and settings.masks == "auto" else str(settings.masks)


def _search(job: Job, paths: Mapping[str, Path], reader: PhotoReader, warn: Any, sizes: Sequence[tuple[int, int]], markers: Markers | None) -> Find:
    """Structure from motion on photographs, with a scratch folder of its own for each name."""
    source, settings = job.source, job.settings
    assert source is not None
    networks = given_networks(settings.features_model, settings.matcher_model)
    features = resolved(settings.max_features) or features_for(len(paths))

    def find(name: str, masks: Mapping[str, Path | None]) -> Capture:
        request = Request(
            source,
            dict(paths),
            job.work / name,
            max_side=settings.feature_image_size,
            features=features,
            matching=settings.matching,
            seed=settings.seed,
            threads=feature_threads(job, sizes, settings.feature_image_size, features, count_cores(), networks=networks is not None),
            masks=dict(masks),
            lens="perspective" if settings.lens == "equirectangular" else settings.lens,
            networks=networks,
            copies=reader.folder,
            markers=markers or {},
        )
        return find_cameras(request, progress=job.progress, safe_point=job.safe_point, warn=warn)

    return find


def _of_turning_subject(job: Job, find: Find, paths: Mapping[str, Path], reader: PhotoReader) -> tuple[Capture | None, bool]:
    """The capture of photographs where a subject seems to have turned before a background that stands still, or None where all of the picture is to be
    used; and whether that is certain.

    Cameras by the subject alone are taken where they have nearly all photographs, or where all of the picture does not explain more.
    """
    masks = masks_of_turning_subject(paths, job.work / "masks", reader, safe_point=job.safe_point, progress=job.progress)
    if not masks:
        return None, False
    job.say("the background stands still between photographs: cameras are estimated from the subject alone; --mask off uses the full images")
    try:
        alone = find("cameras_of_subject", masks)
    except BadInput:
        job.say("the subject alone has too few features; cameras are estimated from the full images")
        return None, True
    if turn([photo for photo in alone.photos if photo.mask is not None]) < MIN_TURN:
        job.say("all cameras look the same way, so the background may be far away; the full images are used")
        return None, False
    if len(alone.photos) < MIN_REGISTERED * len(paths):
        job.say("the subject alone has too few features in some photographs; cameras are also estimated from the full images")
        with contextlib.suppress(BadInput):
            whole = find("cameras", {})
            if turn(whole.photos) >= MIN_TURN and _explained(whole) > _explained(alone):
                job.say("the full images explain more than the subject alone and are used")
                return whole, False
    return replace(alone, provenance=structs.replace(alone.provenance, background="left out")), False


def _explained(capture: Capture) -> float:
    """Photographs with a camera, times the share of the matches that agree: a background that stands still contradicts cameras that move."""
    return len(capture.photos) * (capture.provenance.pairs_agreeing or 0.0)


def _found_by_surroundings(job: Job, find: Find, kind: Silhouettes, masks: Mapping[str, Path], everywhere: Mapping[str, None], reader: PhotoReader) -> Capture:
    """The capture found from all of the photographs; or from what their silhouettes keep, where these fit to each other better then: the object was turned.

    masks, everywhere  what leaves out what is not of the object, and what does not
    """

    def fit(found: Capture) -> float:
        return share_that_fits(found, kind, reader) * len(found.photos)

    what = "masks" if kind.masks else "alpha channels"
    job.say(f"{what} are used as silhouettes; features outside them are used too, because the background moves with the object")
    whole: Capture | None = None
    with contextlib.suppress(BadInput):
        whole = with_masks(find("cameras", everywhere), masks)
        if fit(whole) >= MIN_AGREEING * len(whole.photos):
            return whole
    job.say("the silhouettes do not fit these cameras; cameras are estimated again from the object alone")
    try:
        alone = find("cameras_of_object", masks)
    except BadInput:
        if whole is None:
            raise
        return whole
    return alone if whole is None or fit(alone) > fit(whole) else whole
