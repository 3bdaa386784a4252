"""Checks of photographs before structure from motion: how they look, whether they overlap, and what a run of them will take.

Overlap is checked on small pictures: SIFT features of each, compared with those of the pictures most like it and of the next ones (`stages.sfm.pairs`), and
one epipolar geometry that the matches fit. It is coarser than structure from motion, and quicker by far. docs/experiments/sfm.md
"""

import contextlib
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from efficientnerf.settings import resolved
from pipeline.errors import BadInput
from stages.formats import importers
from stages.formats.importers.photographs import photographs
from stages.formats.importers.source import MIN_IMAGES, Source, abbreviated
from stages.io.capture import FOREGROUND
from stages.io.photo import focal_from_exif, read_photo, working_size
from stages.io.pictures import UnreadableImage, exif_of, opened, read_quality
from stages.io.reader import PhotoReader
from stages.masking.turning import masks_of_turning_subject
from stages.memory.forecast import Known
from stages.poses.memory import memory_needed
from stages.sfm import pairs
from stages.sfm.matches import MAX_WORKERS, MIN_PAIRS_A_WORKER, UPSAMPLE_BELOW
from stages.verdict import looks, run_forecast
from stages.verdict.grades import GRADES
from stages.verdict.verdict import FEW, MORE_PHOTOGRAPHS, TINY, Problem, Verdict, of_looks, of_sizes, plural, zooms

SIDE = 560  # px, longest side of the pictures that overlap is checked on
FEATURES = 800  # of a picture
CHOSEN = 150  # pictures of a larger folder, evenly spaced
MOST_LIKE, NEXT = 3, 2  # pictures that each is compared with
OVERLAP = 14  # matches that fit one geometry, from which two pictures overlap
RATIO, EPIPOLAR_ERROR = 0.8, 1.5  # of the distances of the two best; px
MAX_STILL_MOTION = 1.0  # px that a feature of a background that stands still moves by, at most
SMALL = 640  # px; photographs whose longest side is shorter are small
_EXIF = 34665
TURNING = Problem(
    "background",
    "usable",
    "Part of the picture stands still while the rest moves: probably a subject that turns before a camera on a stand.",
    "A run leaves the background out where it is certain of it. Else give masks of the subject (a folder masks/), or --mask static.",
)

# Seconds of a processor that detects the features of a small picture in REFERENCE, by which others are scaled; docs/experiments/sfm.md
REFERENCE = 0.028
FEATURES_A_MEGAPIXEL, AN_IMAGE = 0.4, 0.2
FIRST_TRAINING, A_SILHOUETTE = 92.0, 0.8  # of --mask foreground, docs/experiments/silhouettes.md
A_PAIR, COMPARING, MANY = 0.006, 0.030, 4096  # of verifying a pair, and of comparing so many features of each with each
CONTRAST = 0.02  # from which SIFT detects about as many features as COLMAP's does
PAIRS_AN_IMAGE = 20  # of retrieval


@dataclass(frozen=True)
class Small:
    """A small picture."""

    keypoints: np.ndarray  # (N, 2) px
    descriptors: np.ndarray  # (N, 128) uint8
    size: tuple[int, int]  # of the photograph, as stored, pixels
    focal: float | None  # pixels of the photograph by its EXIF data, or None
    seconds: float  # of the processor, that its features took


def check(folder: Path, settings: Any, threads: int, later: Mapping[str, Any] | None = None) -> Verdict:
    """The verdict on a source before anything is run.

    settings  of the poses stage
    threads   that a run may use
    later     settings of all stages by their names, where the whole run is to be forecast
    Raises BadInput where there is nothing that could be read.
    """
    source = Source(folder, settings.allow_outside)
    kind = importers.formats_of(folder, settings)[0]
    files = {source.name_of(path): source.real(path) for path in photographs(source)}
    names = sorted(files)
    chosen = names[:: -(-len(names) // CHOSEN)]
    small: dict[str, Small] = {}
    seen: dict[str, looks.Look] = {}
    unreadable: list[tuple[str, str]] = []
    for name in chosen:
        try:
            grey = looks.grey_of(files[name])
            seen[name], small[name] = looks.look(grey, read_quality(files[name])), _small(files[name], grey)
        except UnreadableImage as error:
            unreadable.append((name, str(error)))
    if not small:
        raise BadInput(f"{folder}: no photograph can be read: {abbreviated([f'{name} {why}' for name, why in unreadable])}.")
    overlaps = _overlaps(list(small.values()), settings.seed)
    posed = importers.IMPORTERS[kind].posed
    problems = [*of_looks(seen), *_of_files(small, unreadable, len(names))]
    if posed:
        problems += _of_stated_cameras(folder, kind, settings)
    else:
        problems += of_sizes(seen)
        problems += _with_turning(_of_overlap(list(small), overlaps), {name: files[name] for name in small})
    ordered = tuple(sorted(problems, key=lambda each: -GRADES.index(each.grade)))
    about = forecast(next(iter(small)), files, small, len(names), settings, threads, posed=posed)
    about["poses_bytes"] = memory_needed(Known(folder, [folder], {"poses": settings})).total
    if later is not None:
        whole = kind != "llff" and settings.mask_from != FOREGROUND and not _rendered(kind, files[next(iter(small))])
        about |= _forecast_of_run(about, small, len(names), later, threads, whole=whole)
    figures = {
        "source": str(folder),
        "format": kind,
        "photographs": len(names),
        "looked_at": len(chosen),
        "left_aside": [] if posed else source.warnings(),
        "sizes": sorted({f"{a}x{b}" for a, b in (each.size for each in small.values())}),
        "overlapping": round(len(_groups(len(small), overlaps)[0]) / len(small), 3),
        "forecast": about,
    }
    return Verdict(ordered[0].grade if ordered else "good", ordered, figures, {name: each.figures() for name, each in seen.items()})


def _small(path: Path, grey: np.ndarray) -> Small:
    """grey  (H, W) uint8, the photograph as it is meant to be seen"""
    with opened(path) as image:
        size = image.size
        focal = focal_from_exif(dict(exif_of(image).get_ifd(_EXIF)), *size)
    grey = cv2.resize(grey, working_size(grey.shape[1], grey.shape[0], SIDE), interpolation=cv2.INTER_AREA)
    before = time.thread_time()
    keypoints, descriptors = cv2.SIFT_create(FEATURES).detectAndCompute(grey, None)  # type: ignore[attr-defined]
    seconds = time.thread_time() - before
    found = np.zeros((0, 128)) if descriptors is None else descriptors
    return Small(np.array([point.pt for point in keypoints], np.float32).reshape(-1, 2), found.astype(np.uint8), size, focal, seconds)


@dataclass(frozen=True)
class Overlap:
    """Of two pictures."""

    matches: int  # that fit one epipolar geometry
    still: float  # share of them that do not move
    plane: float  # share of them that fit one homography, as of a camera that turns on its spot


def _overlaps(small: Sequence[Small], seed: int) -> dict[pairs.Pair, Overlap]:
    """Of those that were compared and overlap."""
    count = len(small)
    likeness = pairs.likeness_of([each.descriptors for each in small], seed)
    ranked = pairs.ranks(likeness)
    wanted = {pairs.ordered(i, int(j)) for i in range(count) for j in ranked[i, :MOST_LIKE]}
    wanted |= {(i, i + step) for i in range(count) for step in range(1, NEXT + 1) if i + step < count}
    found = {}
    for i, j in sorted(wanted):
        overlap = overlap_of(small[i], small[j])
        if overlap is not None:
            found[i, j] = overlap
    return found


def overlap_of(one: Small, other: Small) -> Overlap | None:
    """None where too few matches fit one geometry."""
    if min(len(one.descriptors), len(other.descriptors)) < OVERLAP:
        return None
    matched = cv2.BFMatcher(cv2.NORM_L2).knnMatch(one.descriptors.astype(np.float32), other.descriptors.astype(np.float32), k=2)
    best = [pair[0] for pair in matched if len(pair) == 2 and pair[0].distance < RATIO * pair[1].distance]
    if len(best) < OVERLAP:
        return None
    a, b = one.keypoints[[match.queryIdx for match in best]], other.keypoints[[match.trainIdx for match in best]]
    cv2.setRNGSeed(0)
    fitting = cv2.findFundamentalMat(a, b, cv2.FM_RANSAC, EPIPOLAR_ERROR, 0.99)[1]
    inside = np.zeros(len(a), bool) if fitting is None else fitting.ravel() > 0
    if inside.sum() < OVERLAP:
        return None
    a, b = a[inside], b[inside]
    flat = cv2.findHomography(a, b, cv2.RANSAC, 2 * EPIPOLAR_ERROR)[1]
    return Overlap(int(inside.sum()), float((np.linalg.norm(a - b, axis=1) < MAX_STILL_MOTION).mean()), 0.0 if flat is None else float(flat.mean()))


def _groups(count: int, overlaps: Mapping[pairs.Pair, Overlap]) -> list[list[int]]:
    near: dict[int, set[int]] = {i: set() for i in range(count)}
    for i, j in overlaps:
        near[i].add(j)
        near[j].add(i)
    return pairs.components(near)


def _of_overlap(names: Sequence[str], overlaps: Mapping[pairs.Pair, Overlap]) -> list[Problem]:
    groups = _groups(len(names), overlaps)
    share = len(groups[0]) / len(names)
    found = []
    lost = tuple(names[i] for group in groups[1:] for i in group)
    if lost:
        words = plural(len(lost), "overlap with no other, or only among themselves", "overlaps with no other")
        sentence = f"{len(lost)} of {len(names)} photographs that were looked at {words}: {abbreviated(list(lost))}."
        grade = "failed" if len(groups[0]) < MIN_IMAGES else "poor" if share < 0.5 else "usable" if share < 0.9 else "good"
        found.append(Problem("overlap", grade, sentence, MORE_PHOTOGRAPHS, lost))
    if overlaps:
        still = [overlap.still for overlap in overlaps.values()]
        if float(np.median(still)) > 0.9:
            sentence = "Nothing moves between the photographs: the camera stood still."
            found.append(Problem("stands still", "poor", sentence, "Walk round the subject; one place shows no depth."))
        elif np.mean([0.2 < share < 0.9 for share in still]) > 0.5:
            found.append(TURNING)
        elif float(np.median([overlap.plane for overlap in overlaps.values()])) > 0.95:
            sentence = "Neighbouring photographs differ as if the camera had only turned, or as if all were flat and far away."
            found.append(Problem("parallax", "usable", sentence, "Move sideways between photographs, not only turn."))
    return found


def _of_stated_cameras(folder: Path, kind: str, settings: Any) -> list[Problem]:
    """Why a run of a source that states its cameras would be refused."""
    try:
        importers.IMPORTERS[kind].read(folder, settings)
    except BadInput as error:
        remedy = "--as photographs finds the cameras of all photographs afresh."
        return [Problem("cameras", "failed", f"The cameras that the source states cannot be read: {error}", remedy)]
    return []


def _with_turning(problems: Sequence[Problem], files: Mapping[str, Path]) -> list[Problem]:
    """The problems; where nothing seems to move, a small subject may turn before so much of a wall that hardly a feature is its own."""
    if not any(each.what == "stands still" for each in problems):
        return list(problems)
    with tempfile.TemporaryDirectory() as folder:
        turns = masks_of_turning_subject(files, Path(folder), PhotoReader(Path(folder) / "photographs"), safe_point=lambda: None, progress=lambda *_: None)
    return [TURNING if turns and each.what == "stands still" else each for each in problems]


def _of_files(small: Mapping[str, Small], unreadable: Sequence[tuple[str, str]], count: int) -> list[Problem]:
    found = []
    if unreadable:
        which = abbreviated([f"{name} {why}" for name, why in unreadable])
        grade = "usable" if len(unreadable) > 0.1 * (len(small) + len(unreadable)) else "good"
        sentence = f"{len(unreadable)} {plural(len(unreadable), 'photographs', 'photograph')} cannot be read: {which}."
        found.append(Problem("unreadable", grade, sentence, "Copy or convert them again.", tuple(dict(unreadable))))
    if count < FEW:
        grade = "failed" if count < MIN_IMAGES else "poor" if count < 6 else "usable"
        sentence = f"There {plural(count, 'are', 'is')} only {count} {plural(count, 'photographs', 'photograph')}."
        needed = f"At least {MIN_IMAGES} are needed; " if grade == "failed" else ""
        found.append(Problem("few", grade, sentence, f"{needed}20 or more all round a subject are better."))
    reduced = tuple(name for name, each in small.items() if TINY <= max(each.size) < SMALL)
    if len(reduced) > 0.5 * len(small):
        sentence = f"{len(reduced)} of {len(small)} photographs {plural(len(reduced), 'are', 'is')} smaller than {SMALL} px."
        found.append(Problem("small", "usable", sentence, "Give the originals, of 1000 px or more.", reduced))
    groups = zooms({name: 1000.0 * each.focal / max(each.size) for name, each in small.items() if each.focal is not None})
    if len(groups) > 1:
        words = ", ".join(f"{len(group)} at {focal:.0f} px" for focal, group in groups)
        rest = tuple(name for _, group in groups[1:] for name in group)
        grade = "usable" if len(groups) > max(3, 0.2 * len(small)) else "good"
        found.append(Problem("zoom", grade, f"The photographs have {len(groups)} focal lengths: {words}.", "Use one lens at one zoom.", rest))
    return found


def forecast(first: str, files: Mapping[str, Path], small: Mapping[str, Small], count: int, settings: Any, threads: int, *, posed: bool) -> dict[str, Any]:
    """Seconds of the stage poses on a machine that does nothing else, where the mapper's first run suffices, roughly; and the pairs that are compared."""
    side, features = settings.feature_image_size, resolved(settings.max_features) or pairs.features_for(count)
    before, rgb = time.thread_time(), np.zeros((1, 1, 3), np.uint8)
    with contextlib.suppress(UnreadableImage):
        rgb = read_photo(files[first], side).rgb
    reading = 2.5 * (time.thread_time() - before) * count  # for structure from motion, as a working image, and to be looked at
    slower = _slower(small)
    if settings.mask_from == FOREGROUND:
        reading += slower * (FIRST_TRAINING + A_SILHOUETTE * count) / threads
    if posed:
        return {"poses_seconds": round(reading, 1), "pairs": 0}
    reduced = [working_size(*each.size, side) for each in small.values()]
    pixels = [width * height * (4 if max(width, height) < UPSAMPLE_BELOW else 1) for width, height in reduced]
    how = pairs.matching_for(count) if settings.matching == "auto" else settings.matching
    compared = min(count * (count - 1) // 2, 10**9 if how == "exhaustive" else PAIRS_AN_IMAGE * count)
    finding = count * float(np.mean(pixels)) / 1e6 * FEATURES_A_MEGAPIXEL / threads
    detected, workers = min(features, count_features(rgb)), max(1, min(threads, MAX_WORKERS, compared // MIN_PAIRS_A_WORKER))
    matching = compared * (A_PAIR + COMPARING * (detected / MANY) ** 2) / workers  # each feature is compared with each
    mapping = AN_IMAGE * count * max(1.0, count / 50) ** 0.4
    return {"poses_seconds": round(reading + slower * (finding + matching + mapping), 1), "pairs": compared}


def _slower(small: Mapping[str, Small]) -> float:
    """By how much than the machine of REFERENCE."""
    return float(np.median([each.seconds for each in small.values()])) / REFERENCE


def _rendered(kind: str, file: Path) -> bool:
    """Whether the pictures are probably renders of an object, without surroundings."""
    with opened(file) as image:
        return importers.IMPORTERS[kind].renders and "A" in image.getbands()


def _forecast_of_run(
    about: Mapping[str, Any], small: Mapping[str, Small], count: int, later: Mapping[str, Any], threads: int, *, whole: bool
) -> dict[str, Any]:
    """Seconds of each stage, of all, and bytes at the peak; of the seconds None where the later stages were never measured."""
    sizes = [working_size(*each.size, later["poses"].max_image_size) for each in small.values()]
    megapixels = count * float(np.mean([width * height for width, height in sizes])) / 1e6
    seconds = run_forecast.seconds_of(later, views=count, megapixels=megapixels, whole=whole, threads=threads, slower=_slower(small))
    stages = {"poses": about["poses_seconds"], **seconds} if seconds else None
    total = None if stages is None else round(sum(stages.values()), 1)
    needed = run_forecast.bytes_of(later, megapixels=megapixels, whole=whole)
    return {"stage_seconds": stages, "run_seconds": total, "run_bytes": max(about["poses_bytes"], needed)}


def count_features(rgb: np.ndarray) -> int:
    """About as many as structure from motion detects in a photograph's copy, (H, W, 3) uint8, without a limit."""
    grey = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY)
    if max(grey.shape) >= UPSAMPLE_BELOW:  # OpenCV's SIFT doubles any picture
        grey = cv2.resize(grey, (max(1, grey.shape[1] // 2), max(1, grey.shape[0] // 2)), interpolation=cv2.INTER_AREA)
    return len(cv2.SIFT_create(0, contrastThreshold=CONTRAST).detect(grey, None))  # type: ignore[attr-defined]
